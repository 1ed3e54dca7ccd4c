"""Settings changed by name: what is parsed as what, and what a typing error is told."""

import pytest
from small_runs import small

from gftorf_warp.data.read import read
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError
from gftorf_warp.evaluate import provenance
from gftorf_warp.recon import presets
from gftorf_warp.recon.settings import FlowSource
from gftorf_warp.recon.train import CHANGES, reconstruct
from gftorf_warp.scene import changes
from gftorf_warp.scene.changes import names
from gftorf_warp.scene.motion import Products


def changed(settings, texts):
    """Settings of a reconstruction with changes."""
    return changes.changed(settings, texts, CHANGES)


def test_values_become_what_the_setting_holds():
    """Numbers, names, pairs and nothing, in parts and at the top; the last one counts."""
    base = presets.paper()
    texts = [
        "weights.quads=5",
        "init.reflectivity = 0.5",
        "densify.gradient_min=none",
        "quad_scale=10",
    ]
    texts += [
        "init.bounds=0.2,6",
        "flow=dis",
        "motion.products=half",
        "densify.loses_step=TRUE",
        "init.count=7",
    ]
    found = changed(base, [*texts, "init.count=8"])
    assert (found.weights.quads, found.init.reflectivity, found.densify.gradient_min) == (
        5.0,
        0.5,
        None,
    )
    assert (found.quad_scale, found.init.bounds, found.init.count) == (10.0, (0.2, 6.0), 8)
    assert isinstance(found.weights.quads, float)
    assert (found.flow, found.motion.products, found.densify.loses_step) == (
        FlowSource.DIS,
        Products.HALF,
        True,
    )
    assert changed(base, []) == base


def test_every_setting_has_a_name_and_can_be_set_to_what_it_is():
    """Whatever kind it has."""
    for made in presets.PRESETS.values():
        base = made()
        for name in names(base):
            if name in ("preset", "ablation", "method", "cycle"):
                continue
            value = base
            for part in name.split("."):
                value = getattr(value, part)
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            assert changed(base, [f"{name}={text}"]) == base, name


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("weights.quad=5", "weights.quads"),
        ("init.reflectivity", "NAME=VALUE"),
        ("weights=5", "single setting"),
        ("init.count=many", "whole number"),
        ("init.count=1.5", "whole number"),
        ("weights.quads=x", "a number"),
        ("weights.quads=nan", "a number"),
        ("flow=raft", "deepflow"),
        ("init.bounds=1", "2 values"),
        ("densify.loses_step=maybe", "true or false"),
        ("motion.width=0", "width must be at least 1"),
        ("render.depth_bits=20", "depth_bits must be 16 or 24"),
        ("preset=paper", "no such setting"),
        ("quad_scale.x=1", "single setting"),
        ("weights.quads=-1", "quads must be at least 0"),
        ("weights.ssim=1.5", "at most 1"),
        ("rates.mean=1e30", "mean must be at least 0 and at most 10"),
        ("rates_last.motion=-0.1", "motion must be at least 0"),
        ("init.count=0", "count must be at least 1"),
        ("init.bounds=2,1", "a nearer and a farther"),
        ("motion.nodes=0", "nodes must be at least 1"),
        ("schedule.warm_up=-4", "warm_up must be at least 0"),
        ("densify.scale_range=2,1", "in order"),
        ("quad_scale=0", "quad_scale must be above 0"),
        ("background=inf", "background must be at least 0"),
    ],
)
def test_mistakes_are_named(text, hint):
    """With what would have been right."""
    with pytest.raises(UsageError) as caught:
        changed(presets.paper(), [text])
    assert hint in str(caught.value) + str(caught.value.__dict__)
    assert caught.value.where == "--set"


def test_a_run_keeps_what_was_changed(tmp_path):
    """In config.json; another value is another run."""
    run = reconstruct(small(), tmp_path / "run", "demo", images=4, changes=["rates.mean=0.002"])
    assert run.config["settings"]["rates"]["mean"] == 0.002
    again = provenance.how(run.config, None, "", compared={})
    assert "--set rates.mean=0.002" in again
    with pytest.raises(UsageError, match="other settings"):
        reconstruct(small(), tmp_path / "run", "demo", images=4)


def test_a_report_has_the_command_with_its_frame_rate(tmp_path):
    """Without it the folder would be read with other times."""
    write("ftorf", tmp_path / "box", small())
    recorded = read(tmp_path / "box", frame_rate_hz=60.0)
    run = reconstruct(recorded, tmp_path / "run", "ctof")
    assert "--frame-rate 60.0" in provenance.how(run.config, None, "", compared={})
    usual = reconstruct(tmp_path / "box", tmp_path / "usual", "ctof")
    assert "--frame-rate" not in provenance.how(usual.config, None, "", compared={})
