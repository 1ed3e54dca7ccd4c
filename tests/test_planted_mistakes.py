"""Mistakes planted in simulated recordings are found without ground truth; right ones are not
accused. benchmarks/planted_mistakes.py does the same on more scenes.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp.data.check import examine
from gftorf_warp.data.hypotheses import hypotheses
from gftorf_warp.data.report import Report
from gftorf_warp.data.temporal import camera_rests

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import planted_mistakes as planted


@pytest.fixture(scope="module")
def recordings():
    """A random room at rest and one that a camera is carried through."""
    return list(planted.bases([203], (48, 36), 24, carried=("photocopier",)).values())


@pytest.fixture(scope="module")
def room(recordings):
    """The camera at rest."""
    return recordings[0]


def draw():
    """The same random numbers for every mistake."""
    return np.random.default_rng(1)


@pytest.mark.parametrize("name", planted.MISTAKES)
def test_a_planted_mistake_is_found(recordings, name):
    """In the first recording that can have it."""
    mistake = planted.MISTAKES[name]
    sequence = next(s for s in recordings if mistake.moving in (None, not camera_rests(s)))
    found = planted.findings(mistake.plant(sequence, draw()))
    assert set(found) & set(mistake.found_by), found


@pytest.mark.parametrize("name", planted.RIGHT)
def test_a_right_recording_is_not_accused(recordings, name):
    """Camera at rest and carried."""
    for sequence in recordings:
        assert planted.findings(planted.RIGHT[name](sequence, draw())) == []


def test_the_frequency_of_a_camera_at_rest_cannot_be_known(room):
    """All findings and measures are those of the right recording: phases are the same."""
    wrong = planted.UNDETECTABLE["depth_range 20 for 15, camera at rest"].plant(room, draw())
    measures = [[(h.falloff, h.unexplained) for h in hypotheses(s)] for s in (room, wrong)]
    assert measures[0] == measures[1]
    assert planted.findings(wrong) == []


def test_the_right_order_is_the_first_hypothesis(room):
    """Mirrored shifts: the first suggestion is the order as it was, named with its option."""
    mirrored = replace(room, shifts=-room.shifts)
    report = Report(path=None, form="ftorf")
    examine(mirrored, report)
    (said,) = [finding.text for finding in report.findings]
    right = ", ".join(f"{d:.0f}" for d in np.degrees(room.shifts[:4]) % 360)
    assert "better: 1. tof_permutation.npy = [" in said
    assert said.partition("better: 1.")[2].partition(" (")[0].endswith(f"{right} degrees in turn")


def test_hypotheses_of_more_than_four_shifts(room):
    """Not all orders, but every slip and its mirror image; the stated one comes first."""
    slots = np.arange(8) % 5
    shifts = 2 * np.pi * slots / 5
    five = replace(
        room,
        quads=room.quads[:5],
        shifts=shifts[:5],
        **{name: getattr(room, name)[:5] for name in ("measured", "times", "camera_from_world")},
        exposures=None,
    )
    found = hypotheses(five)
    assert len(found) == 10
    assert found[0].order == (0, 1, 2, 3, 4)


def test_the_page_explains_every_finding():
    """docs/check.md has a row for each rule that finds a planted mistake."""
    page = (Path(__file__).parents[1] / "docs" / "check.md").read_text(encoding="utf-8")
    names = {name for mistake in planted.MISTAKES.values() for name in mistake.found_by}
    assert {name for name in names if f"| `{name}` |" not in page} == set()
