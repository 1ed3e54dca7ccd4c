"""Every example runs, and says what it claims to show."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name):
    """The example as a module; its name starts with a digit, so ``import`` cannot."""
    path = EXAMPLES / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_gaussian_decodes_to_where_it_is():
    """Decoded distance of a Gaussian at (0.2, -0.1, 2.5), to a millimetre."""
    assert load("01_one_gaussian").main() == pytest.approx(2.50998, abs=1e-3)


def test_offsets_are_recovered():
    """Phase offset and DC offset come out of the quads of a known scene."""
    example = load("02_gradients_to_the_sensor")
    phase_offset, dc_offset = example.main(steps=140)
    assert phase_offset == pytest.approx(example.TRUE_PHASE_OFFSET, abs=1e-3)
    assert dc_offset == pytest.approx(example.TRUE_DC_OFFSET, abs=1e-3)


def test_a_sequence_is_written(tmp_path):
    """The axial scene in two quartets."""
    path = load("03_simulate").main(tmp_path)
    assert len(list(path.glob("tofType*/*.npy"))) == 8


def test_a_sequence_is_read_and_motion_breaks_its_closed_form(tmp_path, capsys):
    """Far from where something moves the closed form is right,
    at an outline it is off by decimetres.
    """
    path = load("03_simulate").simulate("sliding", tmp_path / "sliding", frames=4, size=(48, 36))
    assert load("04_read_and_check").main(path) > 0.3
    assert "quads: file" in capsys.readouterr().out


def test_reconstruction_from_python(tmp_path):
    """All steps by function calls; the quality is the demo's business, not this test's."""
    metrics = load("05_reconstruct").main(tmp_path, images=24)
    assert metrics["frames"] == 12
    assert metrics["d_mse_x100"] > 0
    assert metrics["closed_form_mse_x100"] > 0


def test_phasors_of_a_moving_camera_from_python(tmp_path):
    """Every phasor is scored, colour too, and the course of the preset fits into few images."""
    metrics = load("06_moving_camera").main(tmp_path, images=20)
    assert metrics["frames"] == 4
    assert metrics["images_optimised"] == 20
    assert metrics["colour_psnr_db"] > 0
    assert metrics["input"] == "phasor"


def test_quads_are_written_as_pictures(tmp_path):
    """16 bits, codes around their zero; tests/test_import_page.py imports them."""
    example = load("07_png_quads")
    sequence = example.main(tmp_path / "quads")
    image = cv2.imread(str(tmp_path / "quads" / "10.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    quad = sequence.quads[10]
    assert np.corrcoef(quad.ravel(), image.ravel())[0, 1] > 0.999
    assert np.array_equal(image[abs(quad) > 0.01] > example.ZERO, quad[abs(quad) > 0.01] > 0)


def test_no_example_is_forgotten():
    """Each file in examples/ is run above."""
    source = Path(__file__).read_text()
    for path in EXAMPLES.glob("*.py"):
        assert f'"{path.stem}"' in source, path.name
