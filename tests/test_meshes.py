"""Meshes out of files: hit where their triangles are, traced like shapes of the same form,
and refused by name.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_trace import CAMERA, GREY, light, plane, scene_of

from gftorf_warp import Sequence, cli
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.scene.camera import Camera
from gftorf_warp.sim.assembly import Assembly, Part
from gftorf_warp.sim.mesh_engine import MeshEngine, triangles_of
from gftorf_warp.sim.meshes import Mesh
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scene_file import read_scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Plane, Texture, first_hit

PATTERN = Texture(low=0.1, high=0.9, cell=0.07)
TURNED = Still(position=(0.1, -0.1, 3.0), turn_deg=(15.0, 40.0, -10.0))
BOX = Box(size=(0.6, 0.9, 0.5))
TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
)


def written(path, points, faces):
    """A PLY or OBJ file with these vertices and faces."""
    if path.suffix == ".obj":
        lines = [f"v {' '.join(map(repr, map(float, p)))}" for p in points]
        path.write_text(
            "\n".join([*lines, *(f"f {' '.join(str(i + 1) for i in f)}" for f in faces)]) + "\n"
        )
        return path
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property double {a}" for a in "xyz"),
    ]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(repr, map(float, p))) for p in points] + [
        f"{len(f)} {' '.join(map(str, f))}" for f in faces
    ]
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


def same_image(bodies, others, time=0.0):
    """Two tuples of bodies have the same first hits, faces aside."""
    got, want = (first_hit(b, CAMERA, time) for b in (bodies, others))
    np.testing.assert_array_equal(got.body, want.body)
    assert (want.body >= 0).sum() > 40
    np.testing.assert_allclose(got.distance, want.distance, rtol=1e-12)
    np.testing.assert_allclose(got.normal, want.normal, atol=1e-9)
    np.testing.assert_allclose(got.amplitude, want.amplitude, rtol=1e-9)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_box_out_of_a_file_is_a_box(tmp_path, suffix, inside):
    """Millimetres scaled, either winding, solid or room: hits,
    normals and light of the closed form.
    """
    size = (6.0, 5.0, 9.0) if inside else BOX.size
    shape = Box(size=size, inside=inside)
    points, triangles = triangles_of(Box(size=size))
    path = Still() if inside else TURNED
    for faces in (triangles, triangles[:, ::-1]):
        file = written(tmp_path / f"box{suffix}", 1e3 * points, faces.tolist())
        mesh = Mesh(file=file, scale=1e-3, inside=inside)
        assert mesh.reach == pytest.approx(shape.reach, rel=1e-12)
        bodies, others = ((Body(shape=s, texture=GREY, path=path),) for s in (mesh, shape))
        same_image(bodies, others)
        np.testing.assert_allclose(
            light(*bodies).amplitude, light(*others).amplitude, rtol=1e-4, atol=1e-6
        )
        hits = MeshEngine(scene_of(*bodies), lambda _: CAMERA).first_hits(0.0)
        np.testing.assert_allclose(
            hits.distance, first_hit(others, CAMERA, 0.0).distance, atol=5e-5
        )


def test_many_triangles_are_hit_as_one_by_one(tmp_path):
    """A bumpy ball of 2,000 quads on its way: truth of the hierarchy is that of all triangles,
    and the tracer's.
    """
    v, u = np.meshgrid(np.arange(1, 40) / 40 * np.pi, np.arange(50) / 50 * 2 * np.pi, indexing="ij")
    r = 0.5 + 0.05 * np.sin(5 * u) * np.sin(v) ** 2
    ring = np.stack(
        [r * np.sin(v) * np.cos(u), r * np.sin(v) * np.sin(u), r * np.cos(v)], -1
    ).reshape(-1, 3)
    points = np.concatenate([ring, [[0, 0, 0.5], [0, 0, -0.5]]])
    at = lambda i, j: 50 * i + j % 50  # noqa: E731
    faces = [
        [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]
        for i in range(38)
        for j in range(50)
    ]
    faces += [[len(ring), at(0, j), at(0, j + 1)] for j in range(50)]
    faces += [[len(ring) + 1, at(38, j + 1), at(38, j)] for j in range(50)]
    mesh = Mesh(file=written(tmp_path / "bumpy.ply", points, faces))
    path = Line(position=(-0.2, 0.1, 1.6), velocity=(1.0, 0.0, -0.5), turn_deg=(15.0, 40.0, -10.0))
    bodies, camera = (
        (plane(3.0), Body(shape=mesh, texture=PATTERN, path=path)),
        Camera.from_fov(96, 72, 60.0),
    )
    got, want = (
        f(0.2)
        for f in (
            MeshEngine(scene_of(*bodies), lambda _: camera).first_hits,
            lambda t: first_hit(bodies, camera, t),
        )
    )
    same = got.body == want.body
    assert (~same).sum() <= 1
    assert (want.body == 1).sum() > 1000
    np.testing.assert_allclose(got.distance[same], want.distance[same], atol=5e-5)
    assert (np.abs(got.normal - want.normal)[same].max(-1) > 2e-5).sum() <= 3  # a ray along an edge
    pose = path.world_from_body(0.2)
    world, tri = mesh.surface[0] @ pose[:3, :3].T + pose[:3, 3], mesh.surface[1]
    rays = camera.rays(dtype=torch.float64).numpy().reshape(-1, 3)
    a, b, c = (world[tri[:, n]] for n in range(3))
    best = np.full(len(rays), np.inf)
    # the textbook way, one triangle after the other
    for corner, e1, e2 in zip(a, b - a, c - a, strict=True):
        p = np.cross(rays, e2)
        det = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = p @ -corner / det, rays @ np.cross(-corner, e1) / det
            t = np.cross(-corner, e1) @ e2 / det
        met = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
        best = np.where(met & (t < best), t, best)
    found = np.isfinite(best) & (want.body.ravel() == 1)
    np.testing.assert_allclose(want.distance.ravel()[found], best[found], atol=1e-9)
    assert found.sum() >= (want.body == 1).sum() - 2


def test_a_sheet_is_seen_from_one_side(tmp_path):
    """Borders need open = true; then it is the rectangle that the file winds,
    and nothing from behind.
    """
    points, triangles = triangles_of(Plane(size=(1.0, 0.8)))
    file = written(tmp_path / "sheet.ply", points, triangles.tolist())
    with pytest.raises(InputError, match="open = true"):
        Mesh(file=file)
    sheet = Mesh(file=file, open=True)
    same_image(
        *((Body(shape=s, texture=GREY, path=TURNED),) for s in (sheet, Plane(size=(1.0, 0.8))))
    )
    behind = Body(
        shape=sheet, texture=GREY, path=Still(position=(0, 0, 2.0), turn_deg=(0.0, 180.0, 0.0))
    )
    assert (first_hit((behind,), CAMERA, 0.0).body < 0).all()
    assert (light(behind).amplitude == 0).all()
    with pytest.raises(ValueError, match="not both"):
        Mesh(file=file, open=True, inside=True)


def test_a_mesh_can_be_a_part(tmp_path):
    """An assembly of a mesh and a box is that of two boxes."""
    mesh = Mesh(file=written(tmp_path / "b.obj", *(x.tolist() for x in triangles_of(BOX))))
    pair = [
        Assembly(
            parts=(Part(shape=s, position=(0.4, 0, 0)), Part(shape=BOX, position=(-0.4, 0, 0)))
        )
        for s in (mesh, BOX)
    ]
    bodies, others = ((Body(shape=s, texture=GREY, path=TURNED),) for s in pair)
    same_image(bodies, others)
    np.testing.assert_allclose(
        light(*bodies).amplitude, light(*others).amplitude, rtol=1e-4, atol=1e-6
    )


def faces_of(*more, points=TETRAHEDRON[0], faces=TETRAHEDRON[1]):
    """A tetrahedron with more faces."""
    return points, [*faces, *more]


@pytest.mark.parametrize(
    ("surface", "why", "fix"),
    [
        ((TETRAHEDRON[0], []), "no triangle", "not a cloud"),
        (
            faces_of(points=np.vstack([TETRAHEDRON[0][:3], [np.nan, 0, 0]])),
            "1 of 4 vertices are no numbers",
            "the first is 3",
        ),
        (faces_of([0, 1, 1]), "1 of 5 triangles have no area", "degenerate"),
        (faces_of(faces=TETRAHEDRON[1][:3]), "open: 3 edges", "open = true"),
        (
            faces_of([0, 1, 4], points=np.vstack([TETRAHEDRON[0], [1.0, -1, 0]])),
            "1 edges have three",
            "split it",
        ),
        (
            faces_of([1, 0, 3], faces=[f for i, f in enumerate(TETRAHEDRON[1]) if i != 1]),
            "3 edges two neighbours",
            "normals",
        ),
        (faces_of([0, 1, 9]), "", ""),
    ],
)
@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_surfaces_that_cannot_be_traced(tmp_path, surface, why, fix, suffix):
    """Empty, not finite, degenerate, open, non-manifold, twisted, out of range: file,
    number and remedy.
    """
    file = written(tmp_path / f"bad{suffix}", *surface)
    with pytest.raises(InputError) as caught:
        Mesh(file=file)
    assert caught.value.where == str(file)
    assert why in caught.value.why
    assert fix in f"{caught.value.why} {caught.value.fix}"


def test_files_that_are_no_meshes(tmp_path):
    """Missing, of another kind, a folder, and rubbish of either kind."""
    (tmp_path / "folder.ply").mkdir()
    for name, content, why in (
        ("none.ply", None, "found none"),
        ("folder.ply", None, "found a folder"),
        ("mesh.stl", "solid", "'.stl'"),
        ("rubbish.ply", "hello", "cannot be read"),
        ("cut.ply", "ply\nformat ascii 1.0\nelement vertex 9\n", ""),
        ("rubbish.obj", "hello", ""),
        ("empty.obj", "", ""),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(InputError) as caught:
            Mesh(file=tmp_path / name)
        assert why in caught.value.why
    with pytest.raises(ValueError, match="scale must be above 0"):
        Mesh(file=tmp_path / "none.ply", scale=0.0)


SCENE = """
[[bodies]]
shape = { kind = "level", axis = 2, value = 3.0 }
texture = { low = 0.2, high = 0.8 }
path = { kind = "still" }
[[bodies]]
shape = { kind = "mesh", file = "parts/box.ply", scale = 0.001 }
texture = { low = 0.2, high = 0.8, gloss = 0.3, shininess = 20 }
path = { kind = "line", position = [0, 0, 2], velocity = [1, 0, 0] }
"""


def test_a_scene_file_names_a_mesh_beside_it(tmp_path, capsys):
    """Found from anywhere, simulated by mesh, refused by gaussian if it moves or shines;
    a bad one writes nothing.
    """
    (tmp_path / "parts").mkdir()
    points, triangles = triangles_of(BOX)
    file = written(tmp_path / "parts" / "box.ply", 1e3 * points, triangles.tolist())
    toml = tmp_path / "mine.toml"
    toml.write_text(SCENE)
    scene = read_scene(toml)
    assert scene.bodies[1].shape == Mesh(file=file, scale=1e-3)
    assert (scene.bodies[1].texture.gloss, scene.bodies[1].texture.shininess) == (0.3, 20.0)
    small = ["--frames", "4", "--size", "24x18", "--engine", "mesh", "-q"]
    assert cli.main(["simulate", str(toml), "--out", str(tmp_path / "a"), *small]) == 0, (
        capsys.readouterr().err
    )
    assert Sequence.open(tmp_path / "a").quads.shape == (4, 18, 24)
    card = (tmp_path / "a" / "README.md").read_text()
    moved = replace(scene.bodies[1], texture=GREY)
    for bodies in (
        (scene.bodies[0], replace(scene.bodies[1], path=TURNED)),
        (scene.bodies[0], moved),
    ):
        with pytest.raises(UsageError, match="glossy or a mesh that moves"):
            simulate(replace(scene, bodies=bodies), tmp_path / "g", frames=4)
        with pytest.raises(UsageError, match="a mesh that moves"):
            record(replace(scene, bodies=bodies), frames=4)
    with pytest.raises(ValueError, match="cannot be covered"):
        moved.shape.grid(0.1, 0.0)
    resting = replace(scene, bodies=(scene.bodies[0], replace(moved, path=TURNED)))
    got, want = (
        record(resting, frames=1, size=(48, 36), noise=False, engine=e)
        for e in ("gaussian", "mesh")
    )
    np.testing.assert_array_equal(got.truth.distance, want.truth.distance)
    assert np.median(np.abs(got.sequence.quads / want.sequence.quads - 1)) < 0.02
    # another mesh of the same name is another scene
    written(file, 2e3 * points, triangles.tolist())
    with pytest.raises(UsageError, match="other settings"):
        simulate(str(toml), tmp_path / "a", frames=4, size=(24, 18), engine="mesh")
    assert "mine" in card
    written(file, points, triangles[1:].tolist())
    assert cli.main(["simulate", str(toml), "--out", str(tmp_path / "b"), *small]) == 3
    assert "box.ply" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
    toml.write_text(SCENE.replace('"parts/box.ply"', "5"))
    with pytest.raises(InputError, match="a path"):
        read_scene(toml)
