"""A run whose Gaussians are changed: rendered, stored, opened, continued, refused."""

import json
from dataclasses import replace

import pytest
import torch
from small_runs import demo, small

from gftorf_warp import Run
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.recon import checkpoint
from gftorf_warp.recon.train import reconstruct

TIME = 0.02


@pytest.fixture(scope="module", params=["nodes", "network"])
def run(request, tmp_path_factory):
    """A short run whose Gaussians move, bound at the start or by their places."""
    settings = demo(images=16, warm_up=4)
    settings = replace(settings, motion=replace(settings.motion, kind=request.param))
    return reconstruct(small(), tmp_path_factory.mktemp("runs") / request.param, settings)


def brighter(field):
    """Return the field with half more light."""
    return replace(field, reflectivity_sh=1.5 * field.reflectivity_sh)


def test_an_edit_is_rendered_stored_and_found_again(run, tmp_path):
    """The same images from memory and from the folder, and others than before."""
    changed = run.edited(brighter(run.field))
    stored = changed.save(tmp_path / "brighter")
    found = [one.render(TIME).quads for one in (run, changed, stored, Run.open(stored.path))]
    assert (found[0] - found[1]).abs().max() > 0
    assert torch.equal(found[1], found[2])
    assert torch.equal(found[2], found[3])
    config = json.loads((stored.path / "config.json").read_text())
    assert config["edited_from"] == str(run.path.resolve())
    assert config["images_optimised"] == 16


def test_a_selection_moves_as_it_did(run):
    """Each Gaussian keeps what it follows, in any order."""
    rows = torch.arange(len(run.field) - 1, -1, -2)
    part = run.edited(run.field.map(lambda tensor: tensor[rows]), rows)
    whole = run.field.moved(*run.motion.at(run.binding, TIME))
    found = part.field.moved(*part.motion.at(part.binding, TIME))
    torch.testing.assert_close(found.mean, whole.mean[rows])


def test_an_edited_run_goes_on(run, tmp_path):
    """`reconstruct` with more images begins at the edited Gaussians, with fresh moments."""
    rows = torch.arange(0, len(run.field), 2)
    part = run.edited(brighter(run.field).map(lambda tensor: tensor[rows]), rows)
    stored = part.save(tmp_path / "part")
    settings = demo(images=20, warm_up=4)
    settings = replace(settings, motion=replace(settings.motion, kind=run.config["motion"]))
    final = reconstruct(small(), stored.path, settings)
    assert final.config["images_optimised"] == 20
    assert len(final.field) == len(rows)
    assert not torch.equal(final.field.mean, part.field.mean)


def test_what_does_not_fit_is_refused(run, tmp_path):
    """By a message that says what would."""
    field = run.field
    with pytest.raises(ValueError, match=r"must have \d+, or state their rows"):
        run.edited(field.map(lambda tensor: tensor[:-1]))
    with pytest.raises(ValueError, match=r"rows must be in 0\.\."):
        run.edited(field, torch.arange(len(field)) + 1)
    with pytest.raises(ValueError, match=r"field has .* the run"):
        run.edited(replace(field, colour_sh=torch.zeros(len(field), 16, 3)))
    with pytest.raises(ValueError, match="mean of Gaussian 0"):
        run.edited(replace(field, mean=field.mean * torch.nan))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(UsageError):
        run.save(tmp_path / "full")


@pytest.mark.parametrize("where", ["field", "motion"])
def test_a_checkpoint_that_is_not_finite_is_refused(run, tmp_path, where):
    """Its images would be NaN, or finite and wrong."""
    copy = run.save(tmp_path / "copy")
    stored = checkpoint.last(copy.path)

    def spoil(value):
        for tensor in value.values():
            if isinstance(tensor, dict):
                spoil(tensor)
            elif isinstance(tensor, torch.Tensor) and tensor.is_floating_point():
                tensor.fill_(torch.nan)

    spoil(stored[where])
    checkpoint.save(copy.path, stored)
    with pytest.raises(InputError, match="not finite"):
        Run.open(copy.path)
