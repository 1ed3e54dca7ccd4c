"""Surfaces of distance images: those of a simulated box, and files of them that others read."""

import numpy as np
import pytest
import trimesh
from analytic_run import BOX, WALL, AnalyticRun

from gftorf_warp import reconstruct
from gftorf_warp.errors import UsageError
from gftorf_warp.export.command import export
from gftorf_warp.render.surface import surface
from gftorf_warp.render.trace import RigidBody, Tracer
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion

HALF = np.array([0.4, 0.3, 0.25])  # [m] of the box, which is centred at the origin
BEHIND = 6.0  # [m] a wall around everything


def pose(eye):
    """A camera at ``eye`` that looks at the origin, y down in the picture."""
    z = -np.asarray(eye) / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    found = np.eye(4)
    found[:3, :3] = x, np.cross(z, x), z
    found[:3, 3] = -found[:3, :3] @ eye
    return found


def box_seen(cameras):
    """[V, H, W] distance of a traced box [m]."""
    box = trimesh.creation.box(2.0 * HALF)
    parts = {"points": box.vertices.astype(float), "triangles": box.faces.astype(np.int32)}
    body = RigidBody(**parts, low=0.5, high=0.5, cell=1.0)
    tracer = Tracer([body], cameras[0].width, cameras[0].height)
    images = [tracer.first_hits(camera, np.eye(4)[None]).distance for camera in cameras]
    return np.nan_to_num(np.stack(images), nan=BEHIND)


def from_box(vertices):
    """Signed distance from the surface of the box [m]."""
    beyond = np.abs(vertices) - HALF
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


@pytest.mark.parametrize("lens", [Distortion(), Distortion(k1=-0.15, p1=0.01)])
def test_a_simulated_box_is_found_within_a_voxel(lens):
    """Seen from four corners: every vertex, the area, and the side that looks outwards."""
    corners = [(x, y, z) for x, y, z in ((1, -1, -1), (-1, -1, -1), (1, 1, 1), (-1, 1, 1))]
    eyes = [np.array(corner) * (1.5, 1.0, 1.8) for corner in corners]
    given = {"distortion": lens}
    cameras = [Camera.from_fov(96, 72, 50.0, camera_from_world=pose(eye), **given) for eye in eyes]
    voxel = 0.025
    low, nodes = -HALF - 5 * voxel, np.ceil(2 * HALF / voxel).astype(int) + 11
    vertices, triangles = surface(box_seen(cameras), cameras, low, tuple(map(int, nodes)), voxel)
    assert np.abs(from_box(vertices)).max() < voxel
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(normals, axis=1).sum()
    assert area == pytest.approx(8.0 * (HALF * np.roll(HALF, 1)).sum(), rel=0.05)
    assert (np.sum(normals * (a + b + c), axis=1) > 0).mean() > 0.99


def test_what_is_hidden_has_no_surface():
    """One camera before a flat box: its front face only, and nothing where nothing is known."""
    camera = Camera.from_fov(96, 72, 50.0, camera_from_world=pose((0.0, 0.0, -1.5)))
    seen = box_seen([camera])
    seen[:, :, 48:] = np.nan
    voxel = 0.025
    nodes = tuple(int(n) for n in np.ceil(2 * HALF / voxel) + 11)
    vertices, _ = surface(seen, [camera], -HALF - 5 * voxel, nodes, voxel)
    front = np.abs(vertices[:, 2] + HALF[2]) < voxel
    assert front.sum() > 100
    assert vertices[:, 0].max() < voxel
    assert vertices[:, 2].max() < -HALF[2] + 5 * voxel, "no back, beyond the truncation"


def test_meshes_of_a_run_as_other_programs_read_them(tmp_path):
    """PLY and OBJ have the same triangles, most of them on the wall and the box."""
    sequence = AnalyticRun(tmp_path).sequence()
    run = reconstruct(sequence, tmp_path / "ctof", "ctof", device="cpu")
    ply, obj = export(run, tmp_path / "out", "mesh,obj", times=[0.0])
    meshes = [trimesh.load(next(folder.iterdir()), process=False) for folder in (ply, obj)]
    header = (ply / "frame_0000.ply").read_bytes()[:400].decode("ascii", "replace")
    assert "comment time_s 0.0\n" in header
    voxel = float(header.partition("comment voxel ")[2].split()[0])
    np.testing.assert_allclose(meshes[0].vertices, meshes[1].vertices, atol=1e-6)
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    apart = np.linalg.norm(meshes[0].vertices, axis=1)
    on_wall, on_box = (np.abs(apart - distance) < voxel for distance in (WALL, BOX))
    assert on_wall.sum() > 1000
    assert on_box.sum() > 50
    assert (on_wall | on_box).mean() > 0.8


def test_nothing_opaque_is_no_surface(tmp_path):
    """Named before a file is written."""
    from export_run import exportable

    run = exportable(tmp_path)
    run.field.opacity_logit[:] = -9.0
    with pytest.raises(UsageError, match="opaque"):
        export(run, tmp_path / "out", "mesh", times=[0.0])
    assert not (tmp_path / "out" / "mesh").exists()
