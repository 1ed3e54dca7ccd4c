"""Method ``volume``: where its samples are, what its grids cover, which raw frames it compares."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording
from torch.testing import assert_close
from volume_steps import terms_of

from gftorf_warp.recon import presets
from gftorf_warp.recon.folder import differences
from gftorf_warp.recon.observations import observe, reduced
from gftorf_warp.recon.settings import plain
from gftorf_warp.recon.volume import composite
from gftorf_warp.recon.volume.models import new_volume
from gftorf_warp.recon.volume.occupancy import Occupancy
from gftorf_warp.recon.volume.rays import CLOSED
from gftorf_warp.recon.volume.settings import GridSettings, OccupancySettings, settings_of
from gftorf_warp.recon.volume.targets import Draw, Targets

CELLS = OccupancySettings(cells=10, update_every=1, warm_up=0, anywhere=0.2)
GRID = GridSettings(
    levels=3, moving_levels=2, flow_levels=2, rows_log2=8, coarsest=4, width=8, values=4,
    occupancy=CELLS,
)  # fmt: skip
BOUNDS = (1.0, 6.0)


def generator(seed=0):
    """Random numbers on the CPU."""
    return torch.Generator().manual_seed(seed)


def middles(rays=4):
    """Middles of ten intervals of z-depth on rays along z, in the unit cube."""
    z = (torch.arange(10) + 0.5) / 10
    return torch.stack([torch.full_like(z, 0.35), torch.full_like(z, 0.75), z], -1).expand(
        rays, -1, -1
    )


def occupied(*cells):
    """A grid in which these cells along z, of one column, are occupied."""
    found = Occupancy(CELLS)
    found.occupied.zero_()
    for z in cells:
        found.occupied[z, 7, 3] = 1.0
    return found


def test_samples_are_where_something_is():
    """All of them in the occupied intervals, alike in each, and together they stand for them."""
    depths = occupied(2, 7, 8).depths(middles(), BOUNDS, 30)
    share = (depths.z - 1.0) / 5.0
    cells = (share * 10).long()
    assert set(cells.unique().tolist()) == {2, 7, 8}
    counts = [(cells[0] == k).sum().item() for k in (2, 7, 8)]
    assert counts == [10, 10, 10]
    assert_close(depths.interval[:, :-1], torch.full((4, 29), 1.5 / 30))
    assert (depths.interval[:, -1] == CLOSED).all()
    assert (depths.z[:, 1:] > depths.z[:, :-1]).all()


def test_some_samples_are_anywhere_while_training():
    """A share of them, each for as much more depth: with the last interval, which has no end, they
    average to the whole ray.
    """
    found, share, whole = occupied(4), [], []
    for seed in range(40):
        depths = found.depths(middles(50), BOUNDS, 25, generator(seed))
        inside = ((depths.z - 1.0) / 0.5).long() == 4
        share.append((~inside).float().mean())
        whole.append(depths.interval[:, :-1].sum(dim=1).mean())
    # 0.2 are anywhere, of which a tenth are in the occupied interval
    assert torch.stack(share).mean().item() == pytest.approx(0.18, abs=0.01)
    last = 0.5 / (25 * 0.02)  # nearly always beyond the occupied interval
    assert torch.stack(whole).mean().item() == pytest.approx(5.0 - last, rel=0.03)


def test_a_ray_through_nothing_is_sampled_evenly():
    """As at the start of a run, when everything counts as occupied."""
    empty = occupied().depths(middles(), BOUNDS, 10)
    assert_close(empty.z[0], 1.25 + 0.5 * torch.arange(10.0))
    assert_close(Occupancy(CELLS).depths(middles(), BOUNDS, 10).z, empty.z)


def test_what_was_seen_lately_is_occupied():
    """A cell and its neighbours, until its weight has decayed; other cells as soon as nothing is
    seen there.
    """
    found = Occupancy(CELLS)
    point = torch.tensor([[[0.55, 0.55, 0.55]]])
    for step in range(60):
        found.note(point, torch.tensor([[[0.0]], [[0.5]]]))
        found.update(step)
    cube = torch.zeros(10, 10, 10)
    cube[4:7, 4:7, 4:7] = 1.0
    assert_close(found.occupied, cube)
    for step in range(60, 100):
        found.note(point, torch.zeros(1, 1, 1))
        found.update(step)
    assert found.occupied.sum() == 0.0


def volume_and_targets(sequence):
    """A volume of the moving box, and what it is compared with."""
    settings = presets.volume()
    options = replace(settings.volume, grid=GRID, samples=8, rays=16)
    settings = replace(settings, volume=options)
    targets = Targets(observe(sequence, settings, "cpu"))
    return new_volume(settings.method, options, targets, 0, torch.device("cpu")), targets, settings


def test_grids_cover_all_rays_and_little_more():
    """In perspective: from the first bound to the last, from one border of the image to the
    other.
    """
    volume, targets, _ = volume_and_targets(recording(frames=8)[0])
    rays = targets.views.rays(0)
    near, far = volume.box.bounds
    unit = volume.unit(rays.at(torch.tensor([[near, far]]).expand(len(rays.origin), 2)))
    assert unit.amin() >= -1e-6
    assert unit.amax() <= 1.0 + 1e-6
    across = unit[..., :2].flatten(0, 1)
    assert_close(across.amin(0), torch.full((2,), 0.5 - 0.5 / 1.05), atol=1e-4, rtol=0)
    assert_close(unit[:, 0, :2], unit[:, 1, :2])


def test_a_step_compares_some_raw_frames_with_the_weight_of_all():
    """One before and one after the start, at random; on average as all of them."""
    volume, targets, settings = volume_and_targets(reduced(recording(frames=16)[0], 16))
    around = targets.around(2)
    assert around.frames == (8, 5, 6, 7, 9, 10, 11)
    pairs = set()
    for seed in range(40):
        some = around.some(1, Draw(seed, torch.device("cpu")))
        start, before, after = some.frames
        pairs.add((before, after))
        assert start == 8
        assert some.before == pytest.approx([(8 - before) / 4])
        assert some.after == pytest.approx([(after - 8) / 4])
        assert some.shift[2] == around.shift[around.frames.index(after)]
    assert pairs == {(b, a) for b in (5, 6, 7) for a in (9, 10, 11)}
    assert around.some(None, Draw(0, torch.device("cpu"))) is around
    targets.quads = torch.zeros_like(targets.quads)
    found = {}
    for beside in (1, 2, None):
        grid = replace(GRID, beside=beside, at_rest=0.0)
        volume.settings = replace(volume.settings, grid=grid)
        terms = [
            terms_of(volume, targets, 5000, settings, Draw(seed, torch.device("cpu")))
            for seed in range(60)
        ]
        found[beside] = float(torch.stack([each["quads"] for each in terms]).detach().mean())
    assert found[1] == pytest.approx(found[None], rel=0.2)
    assert found[2] == pytest.approx(found[None], rel=0.2)


def test_the_distortion_of_a_ray():
    """That of two walls, in closed form, and none of one; a term of the loss with a weight."""
    distance = torch.tensor([[1.0, 3.0]], dtype=torch.float64)
    alpha = torch.tensor([[0.4, 1.0]], dtype=torch.float64)
    samples = composite.Samples(distance=distance, alpha=alpha, strength=alpha)
    found = composite.distortion(samples, samples.transmittance)
    assert found.item() == pytest.approx(2 * 0.4 * 0.6 * 4.0)
    volume, targets, settings = volume_and_targets(reduced(recording(frames=8)[0], 16))
    draw = Draw(0, torch.device("cpu"))
    assert "distortion" not in terms_of(volume, targets, 1, settings, draw)
    settings = replace(settings, weights=replace(settings.weights, distortion=0.5))
    assert terms_of(volume, targets, 1, settings, draw)["distortion"] > 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("levels", 0), ("coarsest", 1), ("growth", 1.0), ("rows_log2", 30),
     ("beside", 0)],
)  # fmt: skip
def test_impossible_grids_are_refused(name, value):
    """By name."""
    with pytest.raises(ValueError, match=name):
        replace(GRID, **{name: value})


@pytest.mark.parametrize(("name", "value"), [("cells", 1), ("anywhere", 1.0), ("kept", 0.0)])
def test_impossible_occupancies_are_refused(name, value):
    """By name."""
    with pytest.raises(ValueError, match=name):
        replace(CELLS, **{name: value})


def test_its_quads_move_with_time():
    """A quartet has features of its own, so the same point has another value at each."""
    volume, targets, _ = volume_and_targets(recording(frames=8)[0])
    torch.nn.init.normal_(volume.field.moving.table, generator=generator())
    points = targets.views.rays(0, torch.arange(5)).at(torch.full((5, 2), 3.0))
    quartets = torch.tensor([0, 1, 0], dtype=torch.int32)
    trunk = volume.trunk(points.expand(3, 5, 2, 3), quartets)
    assert_close(trunk[0], trunk[2])
    assert np.abs((trunk[0] - trunk[1]).detach().numpy()).max() > 1e-2


def test_runs_of_a_removed_setting_are_read_or_refused():
    """With the value that is what is done now a run is the same, and goes on; another is refused by
    name.
    """
    settings = plain(presets.volume())
    assert settings_of(settings["volume"]) == presets.volume().volume
    for rate in (1.0, 0.1):
        older = copy.deepcopy(settings)
        older["volume"]["grid"]["moving_rate"] = rate
        found = differences({"settings": older}, {"settings": settings})
        if rate == 1.0:
            assert settings_of(older["volume"]) == presets.volume().volume
            assert found == []
            continue
        assert found == ["volume.grid.moving_rate was 0.1, now 1.0"]
        with pytest.raises(ValueError, match=r"moving_rate was removed and is 1 now, found 0\.1"):
            settings_of(older["volume"])
