"""Some raw frames of a recording, read alone: the same as of the whole one, from time 0."""

import numpy as np
import pytest
from moving_box import recording

from gftorf_warp.data.excerpt import excerpt
from gftorf_warp.data.read import read, read_truth, read_without_images
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.recon.observations import data_hash

FRAMES = range(4, 12)


@pytest.mark.parametrize("form", ["ftorf", "torf", "capture"])
def test_an_excerpt_is_read_as_if_nothing_else_had_been_recorded(form, tmp_path):
    """Images, times, poses, flow, colour and truth; the hash says what a reconstruction reads."""
    sequence, truth = recording(frames=16, with_flow=form != "torf")
    write(form, tmp_path / "seq", sequence, truth)
    whole = read(tmp_path / "seq")
    part = read(tmp_path / "seq", frames=FRAMES)
    assert part.frames == 8
    assert part.times[0] == 0.0
    assert part.quads.base is None or part.quads.base.shape == part.quads.shape
    np.testing.assert_array_equal(part.quads, whole.quads[4:12])
    np.testing.assert_allclose(part.times, whole.times[4:12] - whole.times[4], atol=1e-12)
    assert data_hash(part) == data_hash(excerpt(whole, FRAMES)) != data_hash(whole)
    np.testing.assert_array_equal(read_truth(part).distance, read_truth(whole).distance[4:12])
    again = read(tmp_path / "seq", frames=range(16))
    assert data_hash(again) == data_hash(whole)


def test_flow_out_of_an_excerpt_is_left_out(tmp_path):
    """As of a recording that ends there."""
    write("capture", tmp_path / "seq", *recording(frames=16))
    flow = read(tmp_path / "seq", frames=FRAMES).flow
    assert set(flow.forward) == {0}
    assert set(flow.backward) == {4}


def test_without_images_everything_else_is_there(tmp_path):
    """Enough to plan with: times, poses, cycle and size."""
    write("capture", tmp_path / "seq", *recording(frames=16))
    found = read_without_images(tmp_path / "seq")
    assert (found.frames, found.cycle, found.quads.shape) == (16, 4, (0, 36, 48))
    np.testing.assert_array_equal(found.times, read(tmp_path / "seq").times)


def test_raw_frames_that_are_not_there(tmp_path):
    """A recording that became shorter, and half a quartet."""
    sequence, _ = recording(frames=16)
    write("capture", tmp_path / "seq", sequence)
    with pytest.raises(InputError, match=r"expected 0 .. 15, asked for 8 .. 19"):
        read(tmp_path / "seq", frames=range(8, 20))
    with pytest.raises(ValueError, match="begins with a quartet"):
        excerpt(sequence, range(2, 10))
