"""Long recordings in windows: one run out of several, at every time of the recording."""

import functools
import gc
import html
import itertools
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_box import recording, with_colour
from small_runs import same, stored

from gftorf_warp import Run, Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.read import read, read_without_images
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.evaluate import provenance
from gftorf_warp.evaluate.caveats import caveats
from gftorf_warp.evaluate.views import RENDERED, gather, views_to_take
from gftorf_warp.export.command import export
from gftorf_warp.recon import checkpoint, presets
from gftorf_warp.recon.folder import read_config, write_config
from gftorf_warp.recon.joined import Joined, Window, blended, folder_of
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.recon.windowed import plan, reconstruct_in_windows
from gftorf_warp.view.subject import Subject

QUARTET = 4 / 120  # [s]
IMAGES = 16
SETTINGS = {"images": IMAGES, "flow": "none", "changes": ["width_max=16"]}
WINDOWS = {"window_s": 4 * QUARTET, "overlap_s": 2 * QUARTET}
START = functools.partial(reconstruct_in_windows, settings="demo", **WINDOWS, **SETTINGS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording of eight quartets on disk."""
    path = tmp_path_factory.mktemp("recording") / "seq"
    return write("capture", path, *recording(frames=32))


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """It in three windows, the first interrupted in the middle, and the images of each call."""
    out, seen = tmp_path_factory.mktemp("runs") / "run", []

    def stop(done, _, window, **__):
        seen.append(done)
        if window == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        START(folder, out, progress=stop)
    with pytest.raises(InputError, match="the first 1 of 3 windows are finished"):
        Run.open(out)
    interrupted = stored(folder_of(out, 0))
    again = []
    finished = START(folder, out, progress=lambda done, total, **_: again.append((done, total)))
    assert min(done for done, _ in again) > IMAGES  # window 0 is skipped
    assert again[-1] == (3 * IMAGES, 3 * IMAGES)
    assert same(interrupted, stored(folder_of(out, 0)))
    return finished


def image(value, **changes):
    """A rendering of one distance [m]."""
    from gftorf_warp import Rendering

    plane = torch.full((2, 3), float(value))
    return replace(
        Rendering(
            quads=plane.expand(4, 2, 3),
            phasor=plane.expand(3, 2, 3),
            colour=None,
            distance=plane,
            opacity=torch.ones(2, 3),
            distortion=torch.zeros(0, 3),
            distance_median=plane,
            extra=None,
            screen=None,
        ),
        **changes,
    )


def window(start, end):
    """A window between two times [s]."""
    return Window(frames=range(4), start=start, end=end)


def test_windows_cover_the_recording_and_share_what_was_asked(folder):
    """Whole quartets, equally long, none longer than asked, neighbours with the overlap."""
    timing = read_without_images(folder)
    for quartets in range(1, 10):
        for overlap in range(quartets):
            found = plan(timing, quartets * QUARTET, overlap * QUARTET)
            frames = [one.frames for one in found]
            assert frames[0].start == 0
            assert frames[-1].stop == 32
            assert {len(one) for one in frames} == {4 * min(quartets, 8)}
            assert all(one.start % 4 == 0 for one in frames)
            for a, b in itertools.pairwise(frames):
                assert a.start < b.start <= a.stop - 4 * overlap
            assert found[-1].end == pytest.approx(32 / 120)


def test_a_time_has_the_window_in_whose_middle_it_is_and_two_at_a_seam():
    """Linear between start of the later and end of the earlier window; a switch without overlap."""
    joined = Joined([window(0, 4), window(3, 7), window(7, 11)], lambda number: number)
    shares = {-1: (0, 0), 1: (0, 0), 3: (0, 0), 3.25: (0, 0.25), 3.75: (0, 0.75), 4: (0, 1)}
    shares |= {5: (1, 0), 6.9: (1, 0), 7: (1, 1), 9: (1, 1), 20: (1, 1)}
    assert {time: joined.share(time) for time in shares} == shares
    long = Joined([window(0, 4), window(1, 5), window(2, 6)], lambda number: number)
    assert long.share(3) == (1, 0)  # in the middle of a window it is alone
    assert long.share(2.5) == (0, 0.5)


def test_few_windows_are_open_at_once():
    """However long the recording."""
    opened = []
    joined = Joined([window(k, k + 2) for k in range(9)], opened.append)
    for time in np.linspace(0, 10, 50):
        joined.rendered(float(time), lambda *_: image(1))
    assert opened == list(range(9))


def test_images_are_mixed_and_distances_only_where_both_agree():
    """Weights sum to one; between a surface and the one behind it there is nothing."""
    a, b = image(2.0), image(2.08)
    b = replace(b, distance=torch.tensor([[2.08, 2.08, 3.0], [2.08, 2.08, 2.08]]))
    b = replace(b, opacity=torch.full((2, 3), 0.5))
    for share, far in ((0.25, 2.0), (0.75, 3.0)):
        mixed = blended(a, b, share)
        torch.testing.assert_close(mixed.quads, torch.full((4, 2, 3), 2 + 0.08 * share))
        torch.testing.assert_close(mixed.distance[0, :2], torch.full((2,), 2 + 0.08 * share))
        assert mixed.distance[0, 2] == far
        assert mixed.opacity[0, 2] == (1.0 if share < 0.5 else 0.5)
        assert mixed.opacity[0, 0] == pytest.approx(1 - 0.5 * share)
    alone = replace(a, distance=torch.zeros(0, 3)), replace(b, distance=torch.zeros(0, 3))
    assert blended(*alone, 0.5).opacity[0, 2] == 0.75
    alone = replace(a, opacity=torch.zeros(0, 3)), replace(b, opacity=torch.zeros(0, 3))
    assert blended(*alone, 0.25).distance[0, 2] == 2.0


def test_a_window_is_the_run_of_its_raw_frames_alone(folder, run, tmp_path):
    """The same bytes as of a recording that begins there, and the same images, at its times."""
    part = read(folder, frames=range(8, 24))
    alone = reconstruct(part, tmp_path / "alone", "demo", **SETTINGS)
    assert same(stored(alone.path), stored(folder_of(run.path, 1)))
    middle = float(read(folder).times[16])
    camera = run.camera.resized(16, 12)
    ours, theirs = run.render(middle, camera), alone.render(middle - 8 / 120, camera)
    torch.testing.assert_close(ours.distance, theirs.distance)
    torch.testing.assert_close(ours.quads, theirs.quads)
    ready = run.renderer(["distance"])(middle, camera)
    torch.testing.assert_close(ready.distance, theirs.distance, atol=1e-4, rtol=0)
    assert run.gaussians == sum(Run.open(folder_of(run.path, k)).gaussians for k in range(3))
    own = Run.open(folder_of(run.path, 1)).sequence()
    np.testing.assert_array_equal(own.quads, part.quads)


def test_images_are_continuous_across_a_seam(run):
    """Before the overlap one window, behind it the other, and no jump in between."""
    camera = run.camera.resized(16, 12)
    earlier, later = (Run.open(folder_of(run.path, k)) for k in (0, 1))
    start = run.joined.windows[1].start
    first, last = run.joined.windows[0].middle, run.joined.windows[1].middle
    torch.testing.assert_close(run.render(first, camera).quads, earlier.render(first, camera).quads)
    torch.testing.assert_close(
        run.render(last, camera).quads, later.render(last - start, camera).quads
    )
    apart = (earlier.render(0.1, camera).quads - later.render(0.1 - start, camera).quads).abs()
    assert apart.max() > 0
    times = np.linspace(first, last, 41)
    quads = torch.stack([run.render(float(time), camera).quads for time in times])
    steps = quads.diff(dim=0).abs().amax(dim=(1, 2, 3))
    assert steps.max() < 0.25 * (quads[-1] - quads[0]).abs().max()


def test_images_of_an_overlap_are_those_that_are_scored(run):
    """Fits are blended, then corrected: by render, by renderer, and in compare, which needs the fit
    as well.
    """
    corrections = {"fallback": True, "outlines": True}

    def with_corrections(one):
        return replace(one, config=one.config | {"settings": one.config["settings"] | corrections})

    joined = run.joined.mapped(with_corrections)
    corrected = replace(with_corrections(run), joined=joined)
    scored = gather(corrected, run.sequence(), [12])
    time = float(run.sequence().times[12])
    assert 0.2 < run.joined.share(time)[1] < 0.8
    assert np.abs(scored.d - scored.d_fit).max() > 0.1
    for shown in (
        corrected.render(time, run.camera),
        corrected.renderer(RENDERED)(time, run.camera),
    ):
        away = np.abs(shown.distance.numpy() - scored.d[0])
        assert (away > 1e-3).mean() < 0.002  # rounding may move a pixel from surface to surface


def test_commands_take_it_for_a_run(run, capsys, tmp_path):
    """compare, render, export and view; what has no meaning is refused by name."""
    shown = Subject.open(run.path)
    assert shown.finished
    assert shown.rendered(16)["distance"].shape == (36, 48)
    assert shown.chi_square(16) is not None
    assert main(["compare", str(run.path), "--device", "cpu", "--json", "-q"]) == 0
    assert '"d_mse_x100"' in capsys.readouterr().out
    out = str(tmp_path / "images")
    times = ["--times", "0.05,0.1,0.2", "--device", "cpu", "-q"]
    assert main(["render", str(run.path), "--out", out, *times]) == 0
    assert main(["export", str(run.path), "--out", out + "x", "--format", "npz", *times]) == 0
    assert main(["export", str(run.path), "--out", out + "y", "--format", "ply", *times]) == 2
    assert "windows/000" in capsys.readouterr().err
    with pytest.raises(UsageError, match="a run in windows"):
        run.save(tmp_path / "copy")


def test_a_damaged_checkpoint_of_a_window_is_named(run, tmp_path):
    """With the images of the checkpoint before; without one, other windows are still rendered."""
    shutil.copytree(run.path, tmp_path / "run")
    window = folder_of(tmp_path / "run", 1)
    last = window / "ckpt" / f"{IMAGES:010d}.pt"
    before = checkpoint.save(window, checkpoint.load(last) | {"images": IMAGES - 4})
    last.write_bytes(b"")
    damaged = Run.open(tmp_path / "run")
    late = 3 * IMAGES - 4
    assert damaged.config["images_optimised"] == late < run.config["images_optimised"]
    (caveat,) = caveats(damaged.config, damaged.sequence(), None)
    assert f"windows/001/{last.name}" in caveat
    assert f"image {late} of {3 * IMAGES}" in caveat
    assert caveats(run.config, run.sequence(), None) == []
    before.write_bytes(b"")
    damaged = Run.open(tmp_path / "run")
    assert damaged.render(0.0, run.camera.resized(16, 12)).distance.shape == (12, 16)
    with pytest.raises(InputError, match="damaged checkpoint"):
        damaged.render(damaged.joined.windows[1].middle)


def test_a_fit_of_a_window_that_was_tried_again_is_named(run, tmp_path):
    """As that of a run by itself."""
    shutil.copytree(run.path, tmp_path / "run")
    window = folder_of(tmp_path / "run", 2)
    tried = [
        {"attempt": number, "start": "init.kind phase", "unexplained_share": 0.5, "kept": kept}
        for number, kept in ((1, False), (2, True))
    ]
    write_config(window, read_config(window) | {"attempts": tried})
    opened = Run.open(tmp_path / "run")
    (caveat,) = caveats(opened.config, opened.sequence(), None)
    assert caveat.startswith("windows/002: The first fit failed")
    assert caveat.endswith("fit 2 stays.")


def test_the_report_has_the_command_that_makes_the_same_windows(folder, run):
    """With the images of one window."""
    report = provenance.how(run.config, None, "", compared={})
    words = shlex.split(html.unescape(report[report.index("gftorf reconstruct") :].splitlines()[0]))
    given = dict(zip(words[3::2], words[4::2], strict=True))
    assert int(given["--images"]) == IMAGES
    again = plan(read_without_images(folder), float(given["--window"]), float(given["--overlap"]))
    assert [one.stored for one in again] == run.config["windows"]


def test_the_report_of_a_window_names_its_raw_frames_and_no_command(folder, run):
    """`gftorf reconstruct` would take the whole recording."""
    window = Run.open(folder_of(run.path, 1))
    report = html.unescape(provenance.how(window.config, None, "", compared={}))
    assert "gftorf reconstruct" not in report
    assert f"# raw frames 8 to 23 of {str(folder.resolve())!r}" in report
    assert "gftorf compare RUN" in report


def test_a_run_in_windows_says_what_is_not_as_published(folder, tmp_path):
    """As that of each of them."""
    settings = presets.fast()
    settings = replace(settings, init=replace(settings.init, count=8))

    def stop(*_, **__):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        START(folder, tmp_path / "run", settings=settings, images=1, progress=stop)
    assumed = read_config(folder_of(tmp_path / "run", 0))["assumed"]
    assert assumed
    assert read_config(tmp_path / "run")["assumed"] == assumed


def test_a_moved_recording_and_another_one(folder, run, tmp_path):
    """The windows find it where the run was told; another recording is refused."""
    moved = write("capture", tmp_path / "moved", *recording(frames=32))
    linked = run.linked(moved)
    assert Path(linked.config["sequence"]) == moved.resolve()
    assert linked.sequence().frames == 32
    again = Run.open(run.path)
    assert again.joined.mapped(lambda one: one.config["sequence"])
    other = write("capture", tmp_path / "other", *recording(frames=32, phase_offset=0.3))
    with pytest.raises(InputError, match="not the sequence of the run"):
        run.linked(other)
    run.linked(folder)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"window_s": 0.03}, "a quartet takes 0.0333"),
        ({"window_s": 2 * QUARTET, "overlap_s": 2 * QUARTET}, "the overlap leaves no window"),
        ({"window_s": float("nan")}, "expected seconds, found nan"),
        ({"overlap_s": -0.1}, "expected seconds, found -0.1"),
        ({"window_s": 5 * QUARTET}, "windows was"),
    ],
)
def test_what_does_not_fit_is_refused(folder, run, changed, message):
    """Before anything is written."""
    with pytest.raises(UsageError) as error:
        START(folder, run.path, **changed)
    assert message in str(error.value)


def test_an_overlap_needs_windows(folder, tmp_path, capsys):
    """Both are options of one thing."""
    words = ["reconstruct", str(folder), "--out", str(tmp_path / "run"), "--overlap", "1"]
    assert main(words) == 2
    assert "--window" in capsys.readouterr().err


def test_colour_of_windows_is_exported(tmp_path):
    """In the units of the recording, as it is rendered."""
    path = write("capture", tmp_path / "seq", with_colour(recording(frames=16)[0], size=(12, 9)))
    windows = {"window_s": 2 * QUARTET, "overlap_s": 0.0}
    changes = ["width_max=16", "weights.colour=1"]
    given = {**windows, "images": 2, "flow": "none", "changes": changes}
    run = reconstruct_in_windows(path, tmp_path / "run", "demo", **given)
    (folder,) = export(run, tmp_path / "out", "npz", times=[0.1])
    with np.load(folder / "frame_0000.npz") as found:
        colour = run.render(0.1, views_to_take(run, run.sequence(), [0.1], None)[1][0]).colour
        np.testing.assert_allclose(found["colour"], colour.numpy(), atol=1e-3)


def test_a_window_leaves_nothing_in_memory(folder, tmp_path):
    """When the next one begins, the sequence of the one before is gone."""
    alive = {}

    def count(*_, window, **__):
        if window not in alive:
            alive[window] = sum(type(one) is Sequence for one in gc.get_objects())

    gc.collect()
    gc.disable()
    try:
        START(folder, tmp_path / "run", images=4, progress=count)
    finally:
        gc.enable()
    assert len(alive) == 3
    assert len({*alive.values()}) == 1
