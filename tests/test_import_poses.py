"""Poses of COLMAP, TUM, nerfstudio and matrices: a simulated camera path, written as each program
defines it, is read back.
"""

import json

import numpy as np
import pytest
from foreign import FRAMES, keys, recording
from ftorf_folder import random_poses
from scipy.spatial.transform import Rotation, Slerp

from gftorf_warp.data.poses import interpolated
from gftorf_warp.errors import InputError
from gftorf_warp.importers.command import read_recording
from gftorf_warp.importers.trajectory_files import read_trajectory

UNIT = 2.5  # [m] length unit of files that have their own
RATE = 120.0


def path_of(count=FRAMES, seed=4):
    """World to camera of a camera that turns and moves; x right, y down, z forward [m]."""
    return random_poses(count, np.random.default_rng(seed))


def centre_and_axes(pose):
    """Centre of a camera in the world and its axes right, down, forward as unit vectors."""
    right, down, forward = pose[:3, :3]
    return -pose[:3, :3].T @ pose[:3, 3], right, down, forward


def colmap(root, poses):
    """images.txt: rotation and translation from world to camera, scalar first; file order is by
    number, not by name; every second line holds points.
    """
    lines = ["# Image list with two lines of data per image:", "#   IMAGE_ID, QW, QX, ...", ""]
    order = np.random.default_rng(0).permutation(len(poses))
    lines = lines[:2]
    for number, n in enumerate(order):
        x, y, z, w = Rotation.from_matrix(poses[n, :3, :3]).as_quat()
        t = poses[n, :3, 3] / UNIT
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *t))
        lines += [f"{number + 1} {numbers} 1 tof/{n}.png", "1.5 2.5 -1" if number % 2 else ""]
    (root / "images.txt").write_text("\n".join(lines) + "\n")
    return {"poses__file": "images.txt", "poses__form": "colmap", "poses__metres_per_unit": UNIT}


def nerfstudio(root, poses):
    """transforms.json: centre and the axes right, up, backward as columns."""
    frames = []
    for n, pose in enumerate(poses):
        centre, right, down, forward = centre_and_axes(pose)
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, centre / UNIT], axis=1)
        frames.append({"file_path": f"./images/{n}.jpg", "transform_matrix": matrix.tolist()})
    text = json.dumps({"fl_x": 9.0, "frames": frames[::-1]})
    (root / "transforms.json").write_text(text)
    name = "transforms.json"
    return {"poses__file": name, "poses__form": "nerfstudio", "poses__metres_per_unit": UNIT}


def tum(root, poses, opengl=False):
    """Time, centre, quaternion of the axes as columns, scalar last; from before to after."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for n, pose in enumerate(poses):
        centre, right, down, forward = centre_and_axes(pose)
        sign = -1 if opengl else 1
        axes = np.stack([right, sign * down, sign * forward], axis=1)
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        values = (1305.5 + n / RATE, *centre, x, y, z, w)
        lines.append(" ".join(f"{v:.17g}" for v in values))
    (root / "path.txt").write_text("\n".join(lines) + "\n")
    axes = "opengl" if opengl else "opencv"
    form = {"poses__file": "path.txt", "poses__form": "tum", "poses__start_s": 1305.5}
    return {**form, "poses__axes": axes}


def tum_opengl(root, poses):
    """The same with x right, y up, z backward."""
    return tum(root, poses, opengl=True)


def matrices_npy(root, poses):
    """World to camera, three rows."""
    np.save(root / "poses.npy", poses[:, :3])
    form = {"poses__file": "poses.npy", "poses__form": "matrices"}
    return {**form, "poses__direction": "world_to_camera"}


def matrices_text(root, poses):
    """Camera to world, 16 numbers a line, OpenGL axes."""
    flip = np.diag([1, -1, -1, 1])
    np.savetxt(root / "poses.txt", (np.linalg.inv(poses) @ flip).reshape(-1, 16))
    form = {"poses__file": "poses.txt", "poses__form": "matrices", "poses__axes": "opengl"}
    return {**form, "poses__direction": "camera_to_world"}


def read(root, **changes):
    """The recording, a file for each raw frame, with keys about poses."""
    quads = root / "quads"
    quads.mkdir(exist_ok=True)
    for n, image in enumerate(recording()[1]):
        np.save(quads / f"{n}.npy", image)
    (root / "keys.toml").write_text(keys(**{"values__zero": 0, "time__rate_hz": RATE} | changes))
    return read_recording("arrays", quads, root / "keys.toml")


WRITERS = (colmap, nerfstudio, tum, tum_opengl, matrices_npy, matrices_text)


@pytest.mark.parametrize("writer", WRITERS, ids=lambda writer: writer.__name__)
def test_a_camera_path_of_every_program(writer, tmp_path):
    """World to camera in metres of every raw frame, whatever order, axes and unit the file has."""
    poses = path_of()
    found = read(tmp_path, **writer(tmp_path, poses))
    np.testing.assert_allclose(found.sequence.camera_from_world, poses, atol=1e-9)
    line = next(text for text in found.understood if text.startswith("poses:"))
    assert f"{FRAMES} of " in line


def test_poses_of_cycles_are_interpolated(tmp_path):
    """Between the first raw frames of cycles; after the last one the pose stays."""
    poses = path_of(3)
    form = {"poses__file": "poses.npy", "poses__form": "matrices"}
    np.save(tmp_path / "poses.npy", poses)
    found = read(tmp_path, **form, poses__direction="world_to_camera")
    got = found.sequence.camera_from_world
    np.testing.assert_allclose(got[[0, 4, 8]], poses, atol=1e-9)
    turned = Rotation.from_matrix(np.linalg.inv(poses)[:, :3, :3])
    middle = Slerp([0, 4, 8], turned)(1).as_matrix()
    np.testing.assert_allclose(np.linalg.inv(got[1])[:3, :3], middle, atol=1e-9)
    assert any("a pose for each cycle" in text for text in found.uncertain)


def test_interpolation_between_stamps():
    """Straight lines and constant turns, exact at the stamps; a single pose is constant."""
    poses = np.linalg.inv(path_of(4))
    stamps = np.array([0.0, 1.0, 1.5, 4.0])
    times = np.array([0.0, 0.25, 1.0, 1.4, 3.9, 4.0])
    got = interpolated(times, stamps, poses)
    turns = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    np.testing.assert_allclose(got[:, :3, :3], turns, atol=1e-9)
    centres = [np.interp(times, stamps, poses[:, k, 3]) for k in range(3)]
    np.testing.assert_allclose(got[:, :3, 3], np.stack(centres, axis=1), atol=1e-12)
    assert np.array_equal(interpolated(times, stamps[:1], poses[:1]), np.repeat(poses[:1], 6, 0))


BAD_FILES = [  # form, content, a word of the error
    ("colmap", "", "found no image"),
    ("colmap", "1 1 0 0 0 0 0 0 1\n\n", "QW QX"),
    ("colmap", "1 0 0 0 0 0 0 0 1 a.png\n\n", "unit quaternions"),
    ("colmap", "1 x 0 0 0 0 0 0 1 a.png\n\n", "line 1"),
    ("tum", "# nothing\n", "found none"),
    ("tum", "1 0 0 0 0 0 0 1\n2 0 0\n", "3 numbers in line 2"),
    ("tum", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "increase"),
    ("tum", "1 0 0 0 0 0 0 2\n", "unit quaternions"),
    ("tum", "1 0 0 inf 0 0 0 1\n", "finite"),
    ("nerfstudio", "[]", "object"),
    ("nerfstudio", "{}", "frames"),
    ("nerfstudio", '{"frames": [3]}', "frames"),
    ("nerfstudio", '{"frames": [{"transform_matrix": 3}]}', "file_path"),
    ("nerfstudio", '{"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}', "4x4"),
    ("nerfstudio", '{"frames": [{"file_path": "a", "transform_matrix": "x"}]}', "4x4"),
    ("matrices", "1 0 0 0\n", "12 or 16"),
    ("matrices", "2 0 0 0 0 2 0 0 0 0 2 0\n", "rotations"),
    ("matrices", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "rotations"),
]


@pytest.mark.parametrize(("form", "content", "word"), BAD_FILES)
def test_a_file_of_no_poses_is_named(form, content, word, tmp_path):
    """Damage, other forms, matrices that scale or mirror."""
    path = tmp_path / "poses.txt"
    path.write_text(content)
    with pytest.raises(InputError) as error:
        read_trajectory(path, form, world_to_camera=False, opengl=False)
    assert word in str(error.value)
    assert "poses.txt" in str(error.value)


@pytest.mark.parametrize("content", [b"", np.zeros((2, 2)), np.array(["a"]), np.zeros((0, 4, 4))])
def test_an_array_of_no_poses_is_named(content, tmp_path):
    """Damaged, or another shape or type."""
    path = tmp_path / "poses.npy"
    path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)
    with pytest.raises(InputError, match="unreadable"):
        read_trajectory(path, "matrices", world_to_camera=False, opengl=False)


BAD_KEYS = [  # writer, changed keys, a word of the error
    (colmap, {"poses__metres_per_unit": None}, "poses.metres_per_unit"),
    (nerfstudio, {"poses__metres_per_unit": None}, "poses.metres_per_unit"),
    (tum, {"poses__start_s": None}, "poses.start_s"),
    (tum, {"poses__start_s": 1305.6}, "from 1305.6"),
    (tum, {"poses__form": None}, "poses.form"),
    (matrices_npy, {"poses__direction": None}, "poses.direction"),
    (matrices_npy, {"poses__file": "../poses.npy"}, "poses.file"),
]


@pytest.mark.parametrize(("writer", "changes", "word"), BAD_KEYS)
def test_keys_of_poses_are_asked_for(writer, changes, word, tmp_path):
    """What the file does not say: unit, time, direction, form."""
    changes = writer(tmp_path, path_of()) | changes
    with pytest.raises(InputError) as error:
        read(tmp_path, **changes)
    assert word in str(error.value)


def test_keys_of_poses_without_a_file_are_no_camera_at_rest(tmp_path):
    """They would do nothing; those that have a default, as in a template, may be there."""
    with pytest.raises(InputError, match=r"poses\.start_s mean nothing without poses\.file"):
        read(tmp_path, poses__form="tum", poses__start_s=3.0)
    assert (read(tmp_path, poses__axes="opencv").sequence.camera_from_world == np.eye(4)).all()


def test_images_are_found_by_name(tmp_path):
    """In full, or without folder and suffix if only one is called so; some without a pose are
    named.
    """
    changes = colmap(tmp_path, path_of())
    text = (tmp_path / "images.txt").read_text()
    twice = text + text.replace("tof/", "left/")
    (tmp_path / "images.txt").write_text(twice)
    with pytest.raises(InputError, match="found 18"):
        read(tmp_path, **changes)
    (tmp_path / "images.txt").write_text(twice.replace("left/7.png", "7.npy"))
    with pytest.raises(InputError, match=r"several, for 0\.npy, 1\.npy"):
        read(tmp_path, **changes)
    full = text.replace("tof/", "").replace(".png", ".npy")
    (tmp_path / "images.txt").write_text(full + text)
    found = read(tmp_path, **changes).sequence
    np.testing.assert_allclose(found.camera_from_world, path_of(), atol=1e-9)
    (tmp_path / "images.txt").write_text(text.replace("tof/7.png", "tof/seven.png"))
    with pytest.raises(InputError, match=r"for 7\.npy"):
        read(tmp_path, **changes)


def test_too_few_poses_are_named(tmp_path):
    """Neither one for each raw frame nor one for each cycle."""
    changes = matrices_npy(tmp_path, path_of(5))
    with pytest.raises(InputError, match=r"9 poses, or one for each of 3 cycles, found 5"):
        read(tmp_path, **changes)
