"""Cornell-Box sequences, written by tests/cornell_folder.py, assembled with one, two, four taps."""

import json

import cornell_folder as cornell
import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.errors import InputError
from gftorf_warp.importers.command import read_recording
from gftorf_warp.importers.radiance import read_radiance


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sequence of 13 instants."""
    path = tmp_path_factory.mktemp("cornell") / "o_12"
    cornell.write(path, 13)
    return path


def of(folder, tmp_path, text):
    """The import with these keys."""
    path = tmp_path / "keys.toml"
    path.write_text(text)
    return read_recording("cornell_box", folder, path)


@pytest.mark.parametrize("packed", [True, False])
def test_radiance_images_are_bit_equal(packed, tmp_path):
    """To what their bytes say, in runs and without; black pixels too."""
    image = np.random.default_rng(7).random((12, 16, 3)) * [1.0, 0.01, 30.0]
    image[3, 4] = 0
    (tmp_path / "a.hdr").write_bytes(cornell.radiance(image, packed))
    found = read_radiance(tmp_path / "a.hdr")
    np.testing.assert_array_equal(found, cornell.stored(image))
    assert (np.abs(found - image) <= image.max(axis=2, keepdims=True) / 128).all()


@pytest.mark.parametrize(
    ("taps", "slots"),
    [
        (1, [(0, 0), (1, 1), (2, 2), (3, 3)]),
        (2, [(0, 0), (0, 2), (1, 1), (1, 3)]),
        (4, [(0, 0), (0, 1), (0, 2), (0, 3)]),
    ],
)
def test_each_tap_takes_its_image_at_its_instant(taps, slots, folder, tmp_path):
    """Of the second material, from instant 2 on; truth is of the same instant."""
    text = f"[assemble]\ntaps = {taps}\nmaterial = 1\nfirst = 2\n[sensor]\nf_mod_hz = 50e6\n"
    imported = of(folder, tmp_path, text)
    sequence, truth = imported.sequence, imported.truth
    assert sequence.frames == 11 * taps  # to the last instant, also of a cycle that is cut off
    for n, (instant, image) in enumerate(slots):
        wanted = cornell.stored(cornell.correlation(2 + instant, 50, image))[..., 1]
        np.testing.assert_array_equal(sequence.quads[n], wanted.astype(np.float32))
        depth = cornell.distance(2 + instant)
        assert np.isnan(truth.distance[n, 0, 0])
        assert np.abs(truth.distance[n] - depth)[0, 1:].max() < depth.max() / 128
        assert sequence.times[n] == pytest.approx(instant / 120)
    degrees = np.degrees(sequence.shifts[:4]).round() % 360
    assert degrees.tolist() == [(-90 * image) % 360 for _, image in slots]


def test_a_sequence_decodes_to_its_truth(folder, tmp_path):
    """Three frequencies of four taps together: within the precision of RGBE."""
    keys = tmp_path / "keys.toml"
    keys.write_text("[assemble]\ntaps = 4\n[sensor]\nf_mod_hz = [20e6, 50e6, 70e6]\n")
    out = tmp_path / "capture"
    line = ["import", "cornell_box", str(folder), "--out", str(out), "--config", str(keys)]
    assert main(line) == 0
    assert main(["check", str(out)]) == 0
    sequence = Sequence.open(out)
    assert sequence.frequencies == (20e6, 50e6, 70e6)
    assert sequence.calibration.dc_offset == pytest.approx(1.5, abs=0.02)
    assert sequence.intrinsics.fx == pytest.approx(8 / np.tan(np.radians(32.5)))
    distance = closed_form_distance(sequence, 0)
    moved = np.abs(distance - cornell.distance(0))[1:]
    assert moved.max() < 0.12  # the wall moves by 0.1 m in a cycle of three instants
    assert sequence.truth().distance.shape == sequence.quads.shape


def test_a_sequence_is_reconstructed_and_compared_with_its_truth(folder, tmp_path):
    """One command each; the closed form is wrong by the motion within a quartet."""
    out, run = str(tmp_path / "capture"), str(tmp_path / "run")
    assert main(["import", "cornell_box", str(folder), "--out", out]) == 0
    line = ["reconstruct", out, "--out", run, "--preset", "ctof", "--device", "cpu"]
    assert main(line) == 0
    assert main(["compare", run, "--device", "cpu"]) == 0
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert 0.1 < scores["closed_form_mse_x100"] < 1


def test_a_moving_camera_is_warned_of(tmp_path):
    """By the name of its folder."""
    for name, warned in (("o_1", False), ("ca_1", True), ("cp_1", True)):
        cornell.write(tmp_path / name, 4)
        imported = read_recording("cornell_box", tmp_path / name)
        assert any("moving camera" in line for line in imported.uncertain) == warned


IMAGE = cornell.radiance(np.ones((12, 16, 3)))


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("002_render_20MHz_phase2.hdr", None, "found none"),
        ("000_render_20MHz_phase0.hdr", b"", "Radiance image"),
        ("001_render_20MHz_phase1.hdr", b"#?RADIANCE\n\n-Y 12 +X 0\n", "found 0x12"),
        ("001_render_20MHz_phase1.hdr", IMAGE.replace(b"12", b"99999", 1), "found 16x99999"),
        ("000_render_20MHz_phase0.hdr", IMAGE.replace(b"16", b"9999", 1), "found 9999x12"),
        ("001_render_20MHz_phase1.hdr", IMAGE.replace(b"-Y 12", b"-Y 11", 1), "found 16x11"),
        ("001_render_20MHz_phase1.hdr", IMAGE[:-1], "damaged"),
        ("001_render_20MHz_phase1.hdr", IMAGE[:90], "truncated"),
        ("001_render_depth.hdr", IMAGE[:-30], "damaged"),
        ("000_render_depth.hdr", None, "no Cornell-Box sequence"),
        ("003_render_depth.hdr", None, "expected 4 instants"),
    ],
)
def test_missing_and_damaged_files_are_named(name, content, word, tmp_path):
    """All of a sequence in one error."""
    cornell.write(tmp_path / "o_1", 4)
    if content is None:
        (tmp_path / "o_1" / name).unlink()
    else:
        (tmp_path / "o_1" / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        read_recording("cornell_box", tmp_path / "o_1")
    assert word in str(error.value)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[assemble]\ntaps = 3", "one of 1, 2, 4"),
        ("[assemble]\nmaterial = 3", "one of 0, 1, 2"),
        ("[assemble]\nfirst = 10", "found 3"),
        ("[sensor]\nf_mod_hz = 30e6", "30MHz_phase0.hdr"),
        ("[camera]\nfx = 20", r"camera.fy"),
    ],
)
def test_keys_that_do_not_fit_are_named(text, word, folder, tmp_path):
    """Numbers of taps, materials, instants and frequencies."""
    with pytest.raises(InputError) as error:
        of(folder, tmp_path, text)
    assert word in str(error.value)


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    """It is no part of the sequence."""
    cornell.write(tmp_path / "o_1", 4)
    path = tmp_path / "o_1" / "000_render_20MHz_phase0.hdr"
    path.rename(tmp_path / "elsewhere.hdr")
    path.symlink_to(tmp_path / "elsewhere.hdr")
    with pytest.raises(InputError, match="a link out of the folder"):
        read_recording("cornell_box", tmp_path / "o_1")


def test_a_file_is_no_sequence(tmp_path):
    """The folder is named."""
    (tmp_path / "a.hdr").write_bytes(IMAGE)
    with pytest.raises(InputError, match="not a folder"):
        read_recording("cornell_box", tmp_path / "a.hdr")
