"""Exported PLY files, read by trimesh and drawn by the equations of the splatting paper in NumPy,
are the colour image of the run: no code of the renderer or of its oracle takes part.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, sections 4 to 6:
covariance R S S R' (eq. 6), its projection J W Sigma W' J' (eq. 5), blending from front to back
(eq. 3), and colour by spherical harmonics around 0.5. As its program does, 0.3 px^2 are added to
the projection, alpha ends at 0.99, and is left out below 1/255.
"""

import numpy as np
import pytest
import trimesh
from export_run import FRAMES, exportable
from scipy.special import sph_harm_y

from gftorf_warp.export.command import export

LOW_PASS_PX2, ALPHA_MAX, ALPHA_MIN = 0.3, 0.99, 1 / 255
VIEW = 1.3  # half widths of the view beyond which the derivative of the projection stays


def vertices_of(path):
    """Properties of all vertices by name, [N] each."""
    data = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    return {name: np.asarray(data[name], np.float64).ravel() for name in data.dtype.names}


def stacked(vertices, *names):
    """Properties side by side, [N, len(names)]."""
    return np.stack([vertices[name] for name in names], axis=1)


def rotations(wxyz):
    """[N, 3, 3] of quaternions [N, 4] of any length."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def harmonics(directions, degree):
    """[N, K] real harmonics of unit vectors, with the sign (-1)^m of Condon and Shortley."""
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            value = sph_harm_y(order, abs(m), polar, azimuth)
            part = value.imag if m < 0 else value.real
            columns.append(part if m == 0 else np.sqrt(2) * part)
    return np.stack(columns, axis=1)


def colours(vertices, places, eye):
    """[N, 3] colour of each Gaussian from the camera's place."""
    rest = sum(name.startswith("f_rest_") for name in vertices)
    per_channel = rest // 3
    towards = places - eye
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    basis = harmonics(towards, round(np.sqrt(per_channel + 1)) - 1)
    shown = []
    for channel in range(3):
        names = [f"f_dc_{channel}"]
        names += [f"f_rest_{channel * per_channel + k}" for k in range(per_channel)]
        shown.append((basis * stacked(vertices, *names)).sum(axis=1) + 0.5)
    return np.maximum(0.0, np.stack(shown, axis=1))


def footprints(vertices, places, camera):
    """[N, 2, 2] covariance of each Gaussian on the image [px^2]."""
    turned = camera.camera_from_world[:3, :3] @ rotations(
        stacked(vertices, "rot_0", "rot_1", "rot_2", "rot_3")
    )
    half = turned * np.exp(stacked(vertices, "scale_0", "scale_1", "scale_2"))[:, None, :]
    z = places[:, 2]
    most = VIEW * camera.width / (2 * camera.fx), VIEW * camera.height / (2 * camera.fy)
    x, y = (np.clip(places[:, k] / z, -most[k], most[k]) for k in (0, 1))
    nothing = np.zeros_like(z)
    slope = np.array(
        [
            [camera.fx / z, nothing, -camera.fx * x / z],
            [nothing, camera.fy / z, -camera.fy * y / z],
        ]
    ).transpose(2, 0, 1)
    flat = slope @ half
    return flat @ flat.transpose(0, 2, 1) + LOW_PASS_PX2 * np.eye(2)


def drawn(path, camera):
    """The colour image [3, H, W] of a PLY file of Gaussians."""
    vertices = vertices_of(path)
    world = stacked(vertices, "x", "y", "z")
    pose = camera.camera_from_world
    places = world @ pose[:3, :3].T + pose[:3, 3]
    shown = colours(vertices, world, -pose[:3, :3].T @ pose[:3, 3])
    inverse = np.linalg.inv(footprints(vertices, places, camera))
    opacity = 1 / (1 + np.exp(-vertices["opacity"]))
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    image, through = np.zeros((3, *rows.shape)), np.ones(rows.shape)
    for n in np.argsort(places[:, 2]):
        if places[n, 2] <= 0:
            continue
        x, y = places[n, :2] / places[n, 2]
        away = np.stack([columns - camera.fx * x - camera.cx, rows - camera.fy * y - camera.cy])
        power = -0.5 * np.einsum("iyx,ij,jyx->yx", away, inverse[n], away)
        alpha = np.minimum(ALPHA_MAX, opacity[n] * np.exp(power))
        alpha[alpha < ALPHA_MIN] = 0.0
        image += shown[n][:, None, None] * alpha * through
        through *= 1 - alpha
    return image


@pytest.mark.parametrize("n", range(0, FRAMES, 3))
def test_an_independent_picture_of_a_ply_file_is_that_of_the_run(n, tmp_path):
    """Colour that depends on the direction, a camera that turns, Gaussians that come and go."""
    run = exportable(tmp_path)
    (folder,) = export(run, tmp_path / "out")
    camera = run.camera.at(run.sequence().camera_from_world[n])
    ours = run.render(run.sequence().times[n], camera).colour.numpy()
    theirs = drawn(folder / f"frame_{n:04d}.ply", camera)
    assert np.ptp(ours) > 0.5
    assert np.abs(theirs - ours).max() < 1e-3
