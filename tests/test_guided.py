"""Paths out of curves, against their definitions."""

import math

import numpy as np
import pytest

from gftorf_warp.sim.curves import Curve, Guided, Turn
from gftorf_warp.sim.lookalikes_torf import carried_camera
from gftorf_warp.sim.paths import Arc, Line


def test_a_curve_is_the_sum_of_its_terms():
    """Each alone, all together; eased terms rest outside their second."""
    time = 0.3
    ease = 0.5 - 0.5 * math.cos(math.pi * time)
    terms = {
        "start": (2.0, 2.0),
        "rate": (3.0, 3.0 * time),
        "acceleration": (9.81, 0.5 * 9.81 * time**2),
        "eased": (0.7, 0.7 * ease),
        "arched": (0.4, 0.4 * math.sin(math.pi * ease)),
    }
    for name, (value, want) in terms.items():
        assert Curve(**{name: value})(time) == pytest.approx(want, rel=1e-12)
    swing = {"swing": 0.2, "swing_hz": 1.6, "swing_phase_deg": 30.0}
    wanted = 0.2 * math.sin(2 * math.pi * 1.6 * time + math.pi / 6)
    assert Curve(**swing)(time) == pytest.approx(wanted, rel=1e-12)
    everything = Curve(**{name: value for name, (value, _) in terms.items()}, **swing)
    assert everything(time) == pytest.approx(
        sum(want for _, want in terms.values()) + wanted, rel=1e-12
    )
    assert [Curve(eased=2.0)(t) for t in (-1.0, 0.0, 1.0, 3.0)] == pytest.approx(
        [0.0, 0.0, 2.0, 2.0]
    )
    assert [Curve(arched=2.0)(t) for t in (-1.0, 0.5, 3.0)] == pytest.approx(
        [0.0, 2.0, 0.0], abs=1e-12
    )


def test_guided_paths_contain_lines_and_arcs():
    """A line, and a circle as an arm that turns: equal poses."""
    line = Line(position=(0.1, -0.2, 3.0), velocity=(2.0, 0.5, -1.0))
    curves = [Curve(start=p, rate=v) for p, v in zip(line.position, line.velocity, strict=True)]
    guided = Guided(x=curves[0], y=curves[1], z=curves[2])
    arc = Arc(centre=(0.2, 0.1, 2.6), radius=1.2, start_deg=-145.0, rate_deg_per_s=200.0)
    turn = Turn(axis="y", angle=Curve(start=145.0, rate=-200.0))
    swung = Guided(x=0.2, y=0.1, z=2.6, turns=(turn,), arm=(1.2, 0.0, 0.0))
    for time in (0.0, 0.13, 0.4):
        np.testing.assert_allclose(
            guided.world_from_body(time), line.world_from_body(time), atol=1e-12
        )
        np.testing.assert_allclose(
            swung.world_from_body(time), arc.world_from_body(time), atol=1e-12
        )


def test_turns_are_done_last_first_and_have_the_documented_sign():
    """Turns take y to z, z to x, x to y; a half turn about z after one about x is not the other
    way round.
    """
    for axis, source, goal in (("x", 1, 2), ("y", 2, 0), ("z", 0, 1)):
        pose = Guided(turns=(Turn(axis=axis, angle=90.0),)).world_from_body(0.0)
        np.testing.assert_allclose(pose[:3, source], np.eye(3)[goal], atol=1e-12)
    pose = Guided(
        turns=(Turn(axis="z", angle=90.0), Turn(axis="x", angle=90.0)), arm=(0, 0, 2.0)
    ).world_from_body(0.0)
    np.testing.assert_allclose(pose[:3, 2], (1, 0, 0), atol=1e-12)  # z by x to -y, then by z to x
    np.testing.assert_allclose(pose[:3, 3], (2, 0, 0), atol=1e-12)
    with pytest.raises(ValueError, match="axis must be one of x, y, z"):
        Turn(axis="w", angle=1.0)


def test_a_carried_camera_looks_at_its_centre():
    """From ``centre`` away, up to its tremor; pitched cameras look down at what is nearer."""
    for time in (0.0, 0.31, 1.0):
        pose = carried_camera(2.3, 6.0, 0.0).world_from_body(time)
        ahead = pose[:3, 3] + 2.3 * pose[:3, 2]
        np.testing.assert_allclose(
            ahead, (0.0, 0.004 * math.sin(6 * math.pi * time), 2.3), atol=1e-12
        )
    level, pitched = (carried_camera(1.7, 5.0, pitch).world_from_body(0.2) for pitch in (0.0, 10.0))
    np.testing.assert_allclose(pitched[:3, 3], level[:3, 3], atol=1e-12)
    assert pitched[1, 2] == pytest.approx(math.sin(math.radians(10.0)))
