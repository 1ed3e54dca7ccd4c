"""The checks of the sensor notes: which test makes each of them,
and those that concern the whole of the simulator.
"""

import ast
import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.trace import Bounces
from gftorf_warp.sim.ladder import LEVELS, resolved
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.settings import SimSettings
from gftorf_warp.sim.simulate import simulate

REPOSITORY = Path(__file__).parents[1]
PAGE = (REPOSITORY / "design" / "sensor-checks.md").read_text(encoding="utf-8")
NUMBERS = {f"T{n}" for n in range(1, 35)}
LATER = {"T25", "T26"}  # features that are not simulated


def rows():
    """Cells of the table by number of the check."""
    found = [
        [cell.strip() for cell in line.strip("| \n").split(" | ")] for line in PAGE.splitlines()
    ]
    table = [cells for cells in found if re.fullmatch(r"T\d+", cells[0])]
    assert len({cells[0] for cells in table}) == len(table), "a check has two rows"
    return {cells[0]: cells for cells in table}


def docstrings_of(path):
    """Docstrings of the tests of a file by name; none if the file names no check."""
    text = path.read_text()
    if not named(text):
        return {}
    functions = [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)]
    return {
        node.name: ast.get_docstring(node) or ""
        for node in functions
        if node.name.startswith("test_")
    }


def named(text):
    """Numbers of checks in a text, `T8 and T9` as well as `T1, T2`."""
    return {f"T{n}" for n in re.findall(r"\bT(\d+)\b", text)} & NUMBERS


def test_every_check_names_its_tests_and_they_exist():
    """All 34 have a row; what it names is there and says the number,
    with a tolerance and what was measured.
    """
    table = rows()
    assert set(table) == NUMBERS
    for number, (_, what, where, tolerance, measured) in table.items():
        references = re.findall(r"`(test_\w+)\.py::(test_\w+)`", where)
        if number in LATER:
            assert not references
            assert measured == "not simulated"
            continue
        assert all((what, tolerance, measured)), number
        assert references, f"{number} has no test"
        for file, name in references:
            docstrings = docstrings_of(REPOSITORY / "tests" / f"{file}.py")
            assert name in docstrings, f"{number}: {file}.py has no {name}"
            assert number in named(docstrings[name]), (
                f"{file}.py::{name} does not say that it is {number}"
            )


def test_no_test_of_a_check_is_missing_in_the_table():
    """What says that it is a check stands in its row."""
    table, said = rows(), 0
    for path in sorted((REPOSITORY / "tests").glob("test_*.py")):
        for name, docstring in docstrings_of(path).items():
            for number in named(docstring.splitlines()[0] if docstring else ""):
                assert f"`{path.name}::{name}`" in table[number][2], (
                    f"{number} does not name {path.name}::{name}"
                )
                said += 1
    assert said > 40


def test_one_seed_is_one_result_and_another_changes_noise_only(tmp_path):
    """T33: twice the same bytes; with another seed, truth,
    mean light and everything but the noise are the same.
    """
    for level in (level.name for level in LEVELS if level.name in ("L0", "L1", "L2", "L4")):
        folders = [
            simulate(
                "demo",
                tmp_path / f"{level}-{k}",
                level=level,
                frames=4,
                size=(16, 12),
                paths=16,
                format="capture",
                seed=seed,
            )
            for k, seed in enumerate((5, 5, 6))
        ]
        first, again, other = (
            {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
            for folder in folders
        )
        assert first == again, level
        changed = {name for name in first if first[name] != other[name]}
        noise = {f"tof/{n:06d}.exr" for n in range(4)} if level != "L0" else set()
        people = {"README.md", "contact_sheet.png", "MANIFEST.sha256"}
        if level == "L4":  # paths are random, too: their light is in the truth
            assert changed >= noise
            assert {name for name in changed if not name.startswith("truth/")} <= noise | people
        else:
            assert noise <= changed <= noise | people, level
    scene, settings = resolved(SCENES["demo"], SimSettings(level="L2", frames=4, size=(16, 12)))
    one, two = (record(scene, settings, noise=False, seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(one.sequence.quads, two.sequence.quads)
    np.testing.assert_array_equal(one.truth.distance, two.truth.distance)


def test_light_is_at_least_as_long_as_its_phasors():
    """T6: the amplitude bounds every harmonic; half the reflectance is half the direct light."""
    scene = SCENES["demo"]
    dim = [
        replace(body.texture, low=body.texture.low / 2, high=body.texture.high / 2)
        for body in scene.bodies
    ]
    half = replace(
        scene, bodies=tuple(replace(b, texture=t) for b, t in zip(scene.bodies, dim, strict=True))
    )
    options = {"harmonics": (1, 2, 5), "bounces": Bounces(count=2, paths=8)}
    light, less = (
        MeshEngine(s, lambda _: scene.camera((32, 24)), **options).light((0.1,), 2e7)
        for s in (scene, half)
    )
    for h in range(3):
        assert (np.abs(light.light[h]) <= light.amplitude * (1 + 1e-6)).all()
    np.testing.assert_allclose(2 * less.direct_amplitude, light.direct_amplitude, rtol=1e-6)
    np.testing.assert_allclose(
        2 * less.direct, light.direct, atol=1e-6 * light.direct_amplitude.max()
    )
    once, twice = (x.amplitude - x.direct_amplitude for x in (less, light))
    assert (4 * once <= twice * (1 + 1e-5)).all(), "light of two surfaces has two reflectances"


def test_the_stored_canary_sings():
    """T34: fits to rays are at least twice as wrong as a fit to its own rendering,
    in every row of the stored table.
    """
    stored = json.loads((REPOSITORY / "benchmarks" / "results" / "cpu_canary.json").read_text())[
        "rows"
    ]
    own = stored.pop("own model")["d_mse_x100"]
    assert {"mesh, one ray", "mesh, 4x4 rays", "gaussian"} <= set(stored)
    assert own > 0
    assert all(row["d_mse_x100"] > 2 * own for row in stored.values())


def benchmark(name):
    """A file of benchmarks/ as a module."""
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "benchmarks" / f"{name}.py")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_canary_sings(tmp_path):
    """T34: live and small: a fit to rays is more than twice as wrong as an equal fit to its own
    rendering.
    """
    canary, options = benchmark("canary"), {"images": 300, "device": "cpu"}
    small = {"size": (32, 24), "frames": 16, "noise": False}
    sequence = simulate("demo", tmp_path / "rays", **small, **canary.ROWS[canary.SOURCE])
    run = reconstruct(sequence, tmp_path / "run", canary.PRESET, **options)
    own = canary.own_model(run, tmp_path / "own")
    again = reconstruct(own, tmp_path / "again", canary.PRESET, **options)
    assert canary.scores(run)["d_mse_x100"] > 2 * canary.scores(again)["d_mse_x100"]
