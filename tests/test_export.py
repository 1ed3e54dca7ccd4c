"""What ``gftorf export`` writes, read back by other libraries."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from export_run import FRAMES, HEIGHT, WIDTH, exportable

from gftorf_warp.constants import FRAME_RATE_HZ
from gftorf_warp.data.exr import read_exr
from gftorf_warp.errors import UsageError
from gftorf_warp.export.command import FORMATS, export
from gftorf_warp.export.listed import LIST
from gftorf_warp.options import command_parsers
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.gaussians import GaussianField, constant_sh


@pytest.fixture
def run(tmp_path):
    """A finished run with colour."""
    return exportable(tmp_path)


def read_ply(path):
    """Properties of the vertices by name, and the lines of the header, as trimesh finds them."""
    vertices = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    header = path.read_bytes().partition(b"end_header")[0].decode("ascii").splitlines()
    return {name: np.asarray(vertices[name]).ravel() for name in vertices.dtype.names}, header


def columns(properties, *names):
    """Some properties side by side."""
    return torch.tensor(np.stack([properties[name] for name in names], axis=1))


def field_of(properties):
    """Gaussians as a viewer of published splats understands them."""
    rest = sum(name.startswith("f_rest_") for name in properties)
    n, own = len(properties["x"]), rest // 3
    colour = torch.zeros(n, 16, 3)
    for c in range(3):
        colour[:, 0, c] = torch.tensor(properties[f"f_dc_{c}"])
        for k in range(own):
            colour[:, 1 + k, c] = torch.tensor(properties[f"f_rest_{c * own + k}"])
    return GaussianField(
        mean=columns(properties, "x", "y", "z"),
        log_scale=columns(properties, "scale_0", "scale_1", "scale_2"),
        quaternion=columns(properties, "rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logit=torch.tensor(properties["opacity"]),
        reflectivity_sh=torch.zeros(n, 16),
        colour_sh=colour,
    )


def test_splats_of_a_ply_file_look_like_the_run(run, tmp_path):
    """Every time, seen by that time's camera; Gaussians outside their window are not there."""
    (folder,) = export(run, tmp_path / "out")
    files = sorted(folder.iterdir())
    assert [path.name for path in files] == [f"frame_{n:04d}.ply" for n in range(FRAMES)]
    poses = run.sequence().camera_from_world
    for n in (0, 3, 5):
        properties, header = read_ply(files[n])
        assert len(properties["x"]) == 2 * len(run.field) // 3
        assert f"comment time_s {run.sequence().times[n]}" in header
        assert f"comment raw_frame {n}" in header
        field = field_of(properties)
        torch.testing.assert_close(field.quaternion.norm(dim=1), torch.ones(len(field)))
        camera = run.camera.at(poses[n])
        again = rasterize(field, camera, run.sensor, run.render_settings).colour
        ours = run.render(run.sequence().times[n], camera).colour
        assert ours.max() > 0.5
        assert (again - ours).abs().max() < 1e-3


def test_property_names_are_the_usual_ones(run, tmp_path):
    """Order, little endian, 32-bit floats, 62 properties at degree 3."""
    (folder,) = export(run, tmp_path / "out", times=[0.0])
    header = (folder / "frame_0000.ply").read_bytes().partition(b"end_header")[0].decode()
    assert header.startswith("ply\nformat binary_little_endian 1.0\n")
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property float")]
    wanted = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    wanted += [f"f_rest_{k}" for k in range(45)]
    wanted += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == wanted


def test_reflectivity_is_grey_between_zero_and_one(tmp_path):
    """Without colour it is what is shown: in the ratios of the run, whatever the direction."""
    run = exportable(tmp_path, colour=False)
    (folder,) = export(run, tmp_path / "out", times=[0.0])
    field = field_of(read_ply(folder / "frame_0000.ply")[0])
    shown = rasterize(field, run.camera, run.sensor, run.render_settings).colour
    assert (shown[0] == shown[1]).all()
    assert (shown[0] == shown[2]).all()
    assert 0.5 < shown.max() < 1.2
    there = run.field.layer != 2
    ours = run.field.map(lambda tensor: tensor[there])
    ratio = torch.relu(field.colour_sh[:, 0, 0] * 0.28209479 + 0.5)
    ratio /= torch.relu(ours.reflectivity_sh[:, 0] * 0.28209479 + 0.5)
    torch.testing.assert_close(ratio, ratio[:1].expand(len(ratio)))
    later = ours.reflectivity_sh[:, 1:] * ratio[0]
    torch.testing.assert_close(field.colour_sh[:, 1:, 0], later)


def test_a_constant_colour_needs_no_further_harmonics(tmp_path):
    """Files are a quarter of the size."""
    run = exportable(tmp_path, colour=False)
    run.field.reflectivity_sh[:, 1:] = 0.0
    (folder,) = export(run, tmp_path / "out", times=[0.0], colour="reflectivity")
    properties, _ = read_ply(folder / "frame_0000.ply")
    assert len(properties) == 17
    assert field_of(properties).colour_sh[:, 0].std() > 0.1


def test_chosen_times(run, tmp_path):
    """Every third instant; times between raw frames have no raw frame."""
    (folder,) = export(run, tmp_path / "a", every=3)
    headers = [read_ply(path)[1] for path in sorted(folder.iterdir())]
    found = [line for header in headers for line in header if "raw_frame" in line]
    assert found == ["comment raw_frame 0", "comment raw_frame 3", "comment raw_frame 6"]
    (folder,) = export(run, tmp_path / "b", times=[0.02, 0.001])
    (_, header), _ = (read_ply(path) for path in sorted(folder.iterdir()))
    assert "comment time_s 0.001" in header
    assert not [line for line in header if "raw_frame" in line]
    with pytest.raises(UsageError, match="--every"):
        export(run, tmp_path / "c", times=[0.0], every=2)


def test_nothing_is_overwritten_or_left_half_written(run, tmp_path, monkeypatch):
    """A second export is refused or moves the first aside; an interrupted one leaves nothing."""
    from gftorf_warp.export import splats

    out = tmp_path / "out"
    export(run, out, times=[0.0])
    before = (out / "ply" / "frame_0000.ply").read_bytes()
    with pytest.raises(UsageError, match="--fresh"):
        export(run, out, times=[0.01, 0.02])
    assert (out / "ply" / "frame_0000.ply").read_bytes() == before
    export(run, out, times=[0.01, 0.02], fresh=True)
    assert len(list((out / "ply").iterdir())) == 2
    assert (out / "old-1" / "ply" / "frame_0000.ply").read_bytes() == before

    def interrupted(path, data):
        if "0001" in path.name:
            raise KeyboardInterrupt
        path.write_bytes(data)

    monkeypatch.setattr(splats, "write_through", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export(run, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_the_same_export_finishes_after_a_kill(run, tmp_path, monkeypatch):
    """What was complete stays; strays of a process that is gone are removed."""
    out, formats = tmp_path / "out", "exr,tum,ply"
    with monkeypatch.context() as patch:
        patch.setitem(FORMATS, "ply", FORMATS["ply"]._replace(write=interrupted))
        with pytest.raises(KeyboardInterrupt):
            export(run, out, formats)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.name != LIST}
    assert {path.name for path in before} >= {"poses.txt", "frame_0000.exr"}
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (out / f".ply.tmp-{gone.pid}-0").mkdir()
    (out / f".{LIST}.tmp-{gone.pid}-1").write_text("{")
    targets = export(run, out, formats)
    assert [path.name for path in targets] == ["exr", "poses.txt", "ply"]
    assert len(list((out / "ply").iterdir())) == FRAMES
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert not list(out.glob(".*"))
    assert export(run, out, formats) == targets


def interrupted(*_, **__):
    """A writer that is stopped."""
    raise KeyboardInterrupt


@pytest.mark.parametrize("spoil", ["field", "seed", "colour", "list"])
def test_another_export_is_not_taken_for_the_same(run, tmp_path, spoil):
    """Edited Gaussians, another state of the folder, another colour, a damaged list."""
    out, given = tmp_path / "out", {}
    (folder,) = export(run, out, times=[0.0])
    if spoil == "field":
        run = run.edited(run.field.map(lambda tensor: tensor.clone()))
        run.field.opacity_logit[0] -= 1.0
    elif spoil == "seed":
        run.config["seed"] = 7
    elif spoil == "colour":
        given = {"colour": "reflectivity"}
    else:
        (out / LIST).write_text("{")
    before = (folder / "frame_0000.ply").read_bytes()
    with pytest.raises(UsageError, match="--fresh"):
        export(run, out, times=[0.0], **given)
    assert (folder / "frame_0000.ply").read_bytes() == before


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"formats": "ply,las"}, "'las'"),
        ({"formats": []}, "nothing"),
        ({"colour": "green"}, "'green'"),
        ({"times": []}, "no time"),
    ],
)
def test_what_cannot_be_exported_is_named(run, tmp_path, given, text):
    """Before anything is written."""
    with pytest.raises(UsageError, match=text):
        export(run, tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


def test_what_the_run_lacks_is_named(tmp_path):
    """Colour, or Gaussians."""
    run = exportable(tmp_path, colour=False)
    with pytest.raises(UsageError, match="--colour reflectivity"):
        export(run, tmp_path / "out", "ply,points", colour="colour")
    none = exportable(tmp_path / "none", count=60)
    empty = none.field.map(lambda tensor: tensor[:0])
    object.__setattr__(none, "field", empty)
    none.config["settings"]["method"] = "ctof"
    with pytest.raises(UsageError, match="no Gaussians"):
        export(none, tmp_path / "out", "points,html")
    assert not (tmp_path / "out").exists()


def test_distance_images_are_the_run_bit_by_bit(run, tmp_path):
    """EXR and NPZ hold the array that ``render`` returns, and z by the cosine of each ray."""
    exr, npz = export(run, tmp_path / "out", "exr,npz", every=4)
    for k, n in enumerate((0, 4)):
        time, camera = n / FRAME_RATE_HZ, run.camera.at(run.sequence().camera_from_world[n])
        ours = next(iter(run.images([time], [camera], ("distance", "opacity", "colour"))))
        channels = read_exr(exr / f"frame_{k:04d}.exr")
        assert ours["distance"].max() > 1.0
        assert channels["distance"].tobytes() == ours["distance"].tobytes()
        np.testing.assert_array_equal(channels["G"], ours["colour"][1])
        with np.load(npz / f"frame_{k:04d}.npz") as arrays:
            assert arrays["distance"].tobytes() == ours["distance"].tobytes()
            np.testing.assert_array_equal(arrays["opacity"], ours["opacity"])
            assert arrays["time_s"] == time
            assert arrays["raw_frame"] == n
            np.testing.assert_array_equal(arrays["camera_from_world"], camera.camera_from_world)
            np.testing.assert_array_equal(arrays["z_depth"], channels["Z"])
            pixels = np.mgrid[0:HEIGHT, 0:WIDTH][::-1].reshape(2, -1) + 0.5
            rays = np.linalg.solve(
                arrays["intrinsics"], np.vstack([pixels, np.ones(pixels[0].shape)])
            )
        cosine = 1.0 / np.linalg.norm(rays, axis=0).reshape(HEIGHT, WIDTH)
        np.testing.assert_allclose(channels["Z"], ours["distance"] * cosine, rtol=1e-6)


def test_points_lie_where_the_run_sees_them(run, tmp_path):
    """Projected by the camera of their time they are pixel centres at the distance; sRGB colour."""
    (folder,) = export(run, tmp_path / "out", "points", every=3)
    for k, n in enumerate((0, 3, 6)):
        properties, header = read_ply(folder / f"frame_{k:04d}.ply")
        camera = run.camera.at(run.sequence().camera_from_world[n])
        rendering = run.render(n / FRAME_RATE_HZ, camera)
        seen = rendering.opacity >= 0.5
        assert 20 < seen.sum() == len(properties["x"])
        assert f"comment raw_frame {n}" in header
        points = columns(properties, "x", "y", "z")
        pixels = camera.project(points) - 0.5
        rows, across = seen.nonzero().T
        torch.testing.assert_close(
            pixels, torch.stack([across, rows], 1).float(), atol=1e-3, rtol=0
        )
        want = (rendering.distance / rendering.opacity)[seen]
        apart = (points - torch.tensor(camera.centre).float()).norm(dim=1)
        torch.testing.assert_close(apart, want, rtol=1e-5, atol=0.0)
        green = rendering.colour[1][seen].clamp(0.0031308, 1.0)
        shown = (255 * (1.055 * green ** (1 / 2.4) - 0.055)).round()
        bright = rendering.colour[1][seen] > 0.01
        found = torch.tensor(properties["green"].astype(np.float32))
        assert (found - shown)[bright].abs().max() <= 1


def test_points_have_the_reflectivity_of_what_they_lie_on(tmp_path):
    """One opaque Gaussian that reflects equally everywhere: its number on every point."""
    run = exportable(tmp_path, colour=False, count=1)
    run.field.reflectivity_sh[:] = constant_sh(torch.tensor([0.7]))
    run.field.opacity_logit[:] = 8.0
    run.field.log_scale[:] = -0.7
    (folder,) = export(run, tmp_path / "out", "points", times=[0.0])
    properties, _ = read_ply(folder / "frame_0000.ply")
    wanted = 0.7 * run.sensor.source_intensity / run.quad_scale
    assert len(properties["x"]) > 30
    # weights of light are T^2, those of opacity T
    np.testing.assert_allclose(properties["reflectivity"], wanted, rtol=1e-3)


def test_a_video_of_an_export(run, tmp_path):
    """One picture per time, distance and colour side by side."""
    (path,) = export(run, tmp_path / "out", "webm", every=2)
    assert path == tmp_path / "out" / "video.webm"
    reader, count = cv2.VideoCapture(str(path)), 0
    while reader.grab():
        count += 1
    assert count == FRAMES // 2
    assert reader.get(cv2.CAP_PROP_FRAME_WIDTH) > 2 * 320


def test_every_format_is_named_where_people_look():
    """On the page and in the help of the command."""
    page = (Path(__file__).parents[1] / "docs" / "export.md").read_text(encoding="utf-8")
    text = command_parsers()["export"].format_help()
    for name in FORMATS:
        assert f"`{name}`" in page, name
        assert re.search(rf"\b{name}\b", text), name
