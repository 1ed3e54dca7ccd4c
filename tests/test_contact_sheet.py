"""The picture of a sequence: one for every kind, of the numbers themselves,
and of no consequence for readers.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from sequences import changed

from gftorf_warp import Sequence, Truth
from gftorf_warp.data import contact_sheet as module
from gftorf_warp.data.contact_sheet import contact_sheet
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate

SIZE = (32, 24)


@pytest.fixture(scope="module")
def recording():
    """Eight raw frames of a carried camera with colour and flow."""
    return record(SCENES["tour"], frames=8, size=SIZE, flow=True)


def titles(sequence, truth):
    """What the panels of a sheet are called; the sheet has something on it."""
    image = cv2.imdecode(
        np.frombuffer(contact_sheet(sequence, truth, "a title"), np.uint8), cv2.IMREAD_COLOR
    )
    assert image.shape[0] > 500
    assert image.std() > 10, "an empty sheet"
    _, rows = module.middle_panels(sequence, truth)
    return [panel.title for row in rows for panel in row]


def test_everything_that_is_known_is_on_it(recording):
    """All shifts of a quartet, amplitude, both distances, the closed form, its error, objects,
    flow, colour.
    """
    found = titles(recording.sequence, recording.truth)
    assert [title.partition(":")[0] for title in found[:4]] == [
        f"raw frame {n}" for n in (4, 5, 6, 7)
    ]
    assert [title.split(": ")[1].split(",")[0] for title in found[:4]] == [
        "0 deg",
        "180 deg",
        "90 deg",
        "270 deg",
    ]
    for word in (
        "amplitude",
        "true distance [m]",
        "closed form [m]",
        "error of",
        "static phasor",
        "objects",
        "colour",
    ):
        assert any(word in title for title in found), word


def test_flow_is_shown_where_it_is(recording):
    """It belongs to the start of a quartet that has another behind it."""
    longer = changed(
        recording.sequence, forward_flow={4: np.full((2, *SIZE[::-1]), np.nan, np.float32)}
    )
    assert any("flow to raw frame 8" in title for title in titles(longer, recording.truth))


@pytest.mark.parametrize(
    "kind",
    ["no truth", "no distance", "one frame", "two frequencies", "one shift", "dark", "all still"],
)
def test_any_sequence_has_one(recording, kind):
    """What is missing is left out, and nothing warns."""
    sequence, truth = recording.sequence, recording.truth
    if kind == "no truth":
        truth = None
    elif kind == "no distance":
        truth = Truth(distance=np.full_like(truth.distance, np.nan), known=truth.known)
    elif kind == "one frame":
        sequence = replace(sequence, measured=np.arange(8) == 5)
    elif kind == "two frequencies":
        sequence = replace(sequence, frequencies_hz=np.where(np.arange(8) < 4, 2e7, 3e7))
    elif kind == "one shift":
        sequence = replace(sequence, shifts=np.zeros(8))
    elif kind == "dark":
        sequence = replace(sequence, quads=np.zeros_like(sequence.quads))
    else:
        truth = replace(truth, distance=np.full_like(truth.distance, 2.0))
    assert titles(sequence, truth)


def test_a_line_of_pixels_has_one():
    """However flat the images are."""
    line = record(SCENES["sliding"], frames=4, size=(700, 1), engine="mesh")
    sheet = np.frombuffer(contact_sheet(line.sequence, line.truth, "a line"), np.uint8)
    assert cv2.imdecode(sheet, cv2.IMREAD_COLOR).std() > 10


def test_unknown_pixels_are_grey_and_ends_are_the_ends_of_the_scale():
    """The colour of a number is that of its place on the bar beside it."""
    image = np.array([[0.0, 1.0, np.nan, 0.5]])
    panel = module.scaled("x", image, (0.0, 1.0), module.diverging)
    assert panel.image[0, 2].tolist() == [*module.UNKNOWN]
    assert panel.image[0, 3].tolist() == [255, 255, 255]
    assert panel.image[0, 0, 2] > panel.image[0, 0, 0], "below the middle is blue"
    assert panel.image[0, 1, 0] > panel.image[0, 1, 2], "above it is red"


@pytest.mark.parametrize("form", ["ftorf", "torf", "capture"])
def test_every_simulated_folder_has_one_and_no_reader_minds(tmp_path, form):
    """With it, without it, with rubbish in its place: the same sequence."""
    path = simulate("demo", tmp_path / "seq", frames=8, size=SIZE, format=form)
    sheet = path / "contact_sheet.png"
    assert cv2.imread(str(sheet)).shape[2] == 3
    first = Sequence.open(path)
    sheet.write_bytes(b"rubbish")
    second = Sequence.open(path)
    sheet.unlink()
    for other in (second, Sequence.open(path)):
        np.testing.assert_array_equal(other.quads, first.quads)
        np.testing.assert_array_equal(other.truth().distance, first.truth().distance)
        np.testing.assert_array_equal(other.truth().phasor_distance, first.truth().phasor_distance)
