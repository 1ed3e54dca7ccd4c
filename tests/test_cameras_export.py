"""Cameras that are exported are read back by the importers; poses that look somewhere do."""

import json
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import trimesh
from export_run import CAMERA, FRAMES, HEIGHT, WIDTH, exportable, poses

from gftorf_warp.errors import InputError
from gftorf_warp.evaluate.views import render_to_video
from gftorf_warp.export.cameras import colmap_camera, quaternion
from gftorf_warp.export.command import export
from gftorf_warp.importers.lens_files import read_lens
from gftorf_warp.importers.trajectory_files import read_trajectory
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.camera_paths import along, look_at, orbit
from gftorf_warp.scene.distortion import Distortion

AS_STATED = {"world_to_camera": False, "opengl": False}
LENSES = [(), (("k1", -0.1), ("p2", 0.01)), (("k1", -0.1), ("k2", 0.02), ("k3", 0.003))]


@pytest.fixture
def run(tmp_path):
    """A finished run with colour and a camera that moves."""
    return exportable(tmp_path)


def test_cameras_are_those_of_the_sequence(run, tmp_path):
    """Poses in all three forms, times of the trajectory, and the pinhole."""
    colmap, nerfstudio, tum = export(run, tmp_path / "out", "colmap,nerfstudio,tum")
    files = {
        "colmap": colmap / "sparse" / "0" / "images.txt",
        "nerfstudio": nerfstudio / "transforms.json",
        "tum": tum,
    }
    for form, path in files.items():
        found = read_trajectory(path, form, **AS_STATED)
        np.testing.assert_allclose(np.linalg.inv(found.camera_to_world), poses(), atol=1e-9)
        if form == "tum":
            np.testing.assert_allclose(found.stamps, np.arange(FRAMES) / 120, atol=1e-8)
    for path in (colmap / "sparse" / "0" / "cameras.txt", nerfstudio / "transforms.json"):
        lens = read_lens(path, None)
        assert lens.size == (WIDTH, HEIGHT)
        assert lens.values["fx"] == pytest.approx(CAMERA.fx)
        assert lens.values["cy"] == pytest.approx(CAMERA.cy)
        assert lens.pixel_centre == "half"


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_is_stated_whole(lens, tmp_path):
    """By the simplest model of COLMAP that has it."""
    camera = replace(CAMERA, distortion=Distortion(**dict(lens)))
    path = tmp_path / "cameras.txt"
    path.write_text(colmap_camera(camera) + "\n")
    found = read_lens(path, None)
    assert {name: found.values[name] for name, _ in lens} == pytest.approx(dict(lens))
    assert bool(found.distortion) == bool(lens)


def test_pictures_and_points_belong_to_the_cameras(run, tmp_path):
    """Every named picture is there; points of COLMAP are those of the point cloud."""
    colmap, nerfstudio, points = export(run, tmp_path / "out", "colmap,nerfstudio,points", every=3)
    named = json.loads((nerfstudio / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in named] == [
        f"images/frame_{k:04d}.png" for k in range(3)
    ]
    assert [frame["time_s"] for frame in named] == pytest.approx([0.0, 3 / 120, 6 / 120])
    for frame in named:
        assert cv2.imread(str(nerfstudio / frame["file_path"])).shape == (HEIGHT, WIDTH, 3)
        assert (colmap / frame["file_path"]).read_bytes()
    rows = (colmap / "sparse" / "0" / "points3D.txt").read_text().splitlines()[1:]
    found = np.array([row.split()[1:4] for row in rows], float)
    cloud = trimesh.load(points / "frame_0000.ply").vertices
    np.testing.assert_allclose(found, cloud, atol=1e-5)


def test_quaternions_of_turns_small_and_large():
    """Against the matrix that they stand for."""
    generator = np.random.default_rng(0)
    for angle in (0.0, 1e-9, 0.3, 3.1, np.pi):
        axis = generator.normal(size=3)
        axis /= np.linalg.norm(axis)
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(angle * axis)[0]
        w, x, y, z = quaternion(pose)
        matrix = trimesh.transformations.quaternion_matrix([w, x, y, z])
        np.testing.assert_allclose(matrix, pose, atol=1e-7)


def test_a_camera_looks_at_its_target():
    """In the middle of the image; what is below it in the world is below it in the picture."""
    import torch

    camera = CAMERA.at(look_at((1.0, -0.5, 0.2), (0.3, 0.4, 2.0)))
    np.testing.assert_allclose(camera.centre, (1.0, -0.5, 0.2), atol=1e-12)
    points = torch.tensor([[0.3, 0.4, 2.0], [0.3, 0.6, 2.0]], dtype=torch.float64)
    middle, below = camera.project(points).numpy()
    np.testing.assert_allclose(middle, (CAMERA.cx, CAMERA.cy), atol=1e-9)
    assert below[1] > middle[1] + 1
    assert below[0] == pytest.approx(middle[0], abs=0.5)
    np.testing.assert_allclose(look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), np.eye(4), atol=1e-12)
    for eye, target in (((0, 0, 0), (0, 2, 0)), ((1, 1, 1), (1, 1, 1))):
        with pytest.raises(ValueError, match="look_at"):
            look_at(eye, target)


def test_an_orbit_keeps_its_pivot_in_place():
    """At the same pixel and distance, from where it starts to its right."""
    import torch

    pivot = np.array([0.2, 0.1, 3.0])
    found = orbit(np.eye(4), pivot, 60.0, 5)
    cameras = [Camera.from_fov(WIDTH, HEIGHT, 60.0, camera_from_world=pose) for pose in found]
    np.testing.assert_allclose(found[0], np.eye(4))
    pixels = [camera.project(torch.tensor(pivot)).numpy() for camera in cameras]
    np.testing.assert_allclose(pixels, [pixels[0]] * 5, atol=1e-9)
    apart = [np.linalg.norm((camera.centre - pivot)[[0, 2]]) for camera in cameras]
    np.testing.assert_allclose(apart, apart[0])
    assert all(a.centre[0] < b.centre[0] for a, b in pairwise(cameras))


def test_a_path_leads_through_its_poses():
    """Ends and middle are given, halves are half-way."""
    turned = look_at((2.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    found = along(np.stack([np.eye(4), turned, np.eye(4)]), 5)
    np.testing.assert_allclose(found[[0, 2, 4]], [np.eye(4), turned, np.eye(4)], atol=1e-12)
    half = np.linalg.inv(found[1])
    np.testing.assert_allclose(half[:3, 3], (1.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(half[:3, 2], (np.sqrt(0.5), 0.0, np.sqrt(0.5)), atol=1e-12)


def test_a_path_can_be_filmed(run, tmp_path):
    """Poses as an array, one picture each; others than rigid ones are refused."""
    path = orbit(np.eye(4), (0.0, 0.0, 3.0), 30.0, 4)
    film = render_to_video(run, tmp_path / "orbit.webp", "distance", poses=path)
    count = cv2.imcount(str(film))
    assert count == 4
    with pytest.raises(InputError, match="rigid"):
        render_to_video(run, tmp_path / "bad.webp", "distance", poses=2.0 * path)
