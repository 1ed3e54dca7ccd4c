"""The picture of a check: hypotheses on the order of the shifts, and that its advice mends them."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from ftorf_folder import scene

from gftorf_warp.cli import main
from gftorf_warp.data.check import check
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError

HEIGHT, WIDTH = 24, 32


def mirrored():
    """A plain slanted wall whose shifts are stated with the other sign."""
    y, x = np.mgrid[-0.5 : 0.5 : HEIGHT * 1j, -0.5 : 0.5 : WIDTH * 1j]
    distance = 2.5 / (1.0 - x - 0.31 * y)
    sequence = scene(8, HEIGHT, WIDTH, distance=distance)[0]
    phase = 4 * np.pi * distance / 15.0 + 0.3 - sequence.shifts[:, None, None]
    quads = ((np.cos(phase) + 0.2) / distance**2).astype(np.float32)
    return dataclasses.replace(sequence, quads=quads, shifts=-sequence.shifts)


def test_the_permutation_that_is_suggested_mends_the_order(tmp_path):
    """Stored as it is said, the first suggestion leaves nothing to say."""
    folder = write("ftorf", tmp_path / "seq", mirrored())
    (finding,) = check(folder).findings
    assert finding.name == "order"
    listed = finding.text.partition("better: 1. tof_permutation.npy = [")[2].partition("]")[0]
    np.save(folder / "tof_permutation.npy", np.array([int(k) for k in listed.split(",")]))
    assert check(folder).findings == []


def test_the_sheet_shows_hypotheses(tmp_path, capsys):
    """Two rows more than a sheet without them; the folder is as it was."""
    folder = write("ftorf", tmp_path / "seq", mirrored())
    before = sorted(folder.rglob("*"))
    assert main(["check", str(folder), "--sheet", str(tmp_path / "sheet.png")]) == 0
    assert "[order]" in capsys.readouterr().out
    assert sorted(folder.rglob("*")) == before
    with_hypotheses = cv2.imread(str(tmp_path / "sheet.png"))
    (tmp_path / "dark").mkdir()
    dark = dataclasses.replace(mirrored(), measured=np.arange(8) % 4 > 0)
    check(write("ftorf", tmp_path / "dark/seq", dark), tmp_path / "dark.png")
    without = cv2.imread(str(tmp_path / "dark.png"))
    assert with_hypotheses.shape[0] > without.shape[0] + 500
    assert with_hypotheses.std() > 10.0


def test_a_sheet_by_the_name_of_another_format_is_refused(tmp_path, capsys):
    """It would be a PNG that viewers take for something else."""
    assert main(["check", str(tmp_path), "--sheet", str(tmp_path / "sheet.jpg")]) == 2
    assert ".png" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_sheet_that_cannot_be_written_is_a_named_error(tmp_path, capsys):
    """A folder that does not exist: no traceback, nothing written."""
    folder = write("ftorf", tmp_path / "seq", mirrored())
    assert main(["check", str(folder), "--sheet", str(tmp_path / "none/sheet.png")]) == 2
    assert "cannot write" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["capture", "torf"])
def test_advice_names_the_place_in_each_format(tmp_path, form):
    """Shifts of captures are in capture.json, those of phasors cannot be stated."""
    if form == "torf":
        sequence = mirrored()
        folder = write("torf", tmp_path / "seq", sequence)
        words = "re and im of the phasors"
    else:
        folder, words = write("capture", tmp_path / "seq", mirrored()), "frames.shift_rad"
    said = [finding.text for finding in check(folder).findings if finding.name == "order"]
    assert words in said[0]


def test_the_shifts_that_are_suggested_mend_a_capture(tmp_path):
    """Stored as it is said, with the manifest removed as it is said, nothing is left to say."""
    folder = write("capture", tmp_path / "seq", mirrored())
    before = check(folder)
    listed = before.warnings[0].partition("1. frames.shift_rad in capture.json, ")[2]
    degrees = [float(d) for d in listed.partition(" degrees in turn")[0].split(",")]
    content = json.loads((folder / "capture.json").read_text())
    for frame in content["frames"]:
        frame["shift_rad"] = np.radians(degrees[frame["id"] % len(degrees)])
    (folder / "capture.json").write_text(json.dumps(content))
    (said,) = (line for line in before.lines if line.startswith("manifest"))
    with pytest.raises(InputError, match="content changed"):
        check(folder)
    assert "MANIFEST.sha256" in said
    assert "remove it" in said
    (folder / "MANIFEST.sha256").unlink()
    assert check(folder).findings == []


@pytest.mark.parametrize(
    ("form", "place"),
    [
        ("capture", "frames.camera_to_world in capture.json"),
        ("ftorf", "cams/tof_extrinsics.npy and cams/poses.json"),
        ("torf", "cams/tof_extrinsics.npy"),
    ],
)
def test_poses_are_asked_for_where_the_format_has_them(tmp_path, form, place):
    """Poses of F-ToeRF also need the file that makes them count."""
    still = mirrored()
    changing = still.quads * np.repeat([1.0, -2.0], 4).astype(np.float32)[:, None, None]
    folder = write(form, tmp_path / "seq", dataclasses.replace(still, quads=changing))
    (said,) = (finding.text for finding in check(folder).findings if finding.name == "poses")
    assert said.endswith(f"store its poses in {place}")
