"""Examples in docstrings and on pages run as they are printed: every public name has one."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import gftorf_warp

PAGES = Path(__file__).parents[1] / "docs"
ELSEWHERE = ("import.md",)  # followed word by word in tests/test_import_page.py
NAMES = [name for name in gftorf_warp.__all__ if name != "__version__"]
TINY = {"frames": 8, "size": (24, 18)}
SHORTER = {  # what pages call with the values of a user who waits
    ("gftorf_warp", "simulate"): TINY,
    ("gftorf_warp", "reconstruct"): {"images": 8, "fresh": True},
    ("gftorf_warp.scene.camera_paths", "orbit"): {"count": 3},
}
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.REPORT_NDIFF


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where examples write: what one has made, another finds finished."""
    return tmp_path_factory.mktemp("examples")


def examples_of(name):
    """Examples in the docstring of a public name, and in those of its methods."""
    thing = getattr(gftorf_warp, name)
    home = inspect.getmodule(thing)
    found = doctest.DocTestFinder(exclude_empty=True).find(thing, name, module=home, globs={})
    return [test for test in found if test.examples]


@pytest.mark.parametrize("name", NAMES)
def test_examples_of_a_public_name(name, folder, monkeypatch):
    """Its output is what the docstring says."""
    monkeypatch.chdir(folder)
    tests = examples_of(name)
    assert tests, f"{name} has no example in its docstring"
    for test in tests:
        printed = []
        doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=printed.append)
        assert printed == [], "".join(printed)


def with_values(function, values):
    """A function whose callers get these keyword arguments, whatever they give."""
    return lambda *given, **named: function(*given, **(named | values))


def blocks():
    """(page, number, Python) of the pages of docs/."""
    for page in sorted(set(PAGES.glob("*.md")) - {PAGES / name for name in ELSEWHERE}):
        text = page.read_text(encoding="utf-8")
        found = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        yield from ((page.name, k, code) for k, code in enumerate(found, start=1))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with what pages take for granted: runs `run` and `RUN`, an export `out`."""
    from gftorf_warp.export.command import export

    folder = tmp_path_factory.mktemp("pages")
    sequence = gftorf_warp.simulate("demo", folder / "sequence", **TINY)
    for name in ("run", "RUN"):
        run = gftorf_warp.reconstruct(sequence, folder / name, images=8)
    export(run, folder / "out", "exr")
    return folder


@pytest.mark.parametrize(
    ("page", "code"),
    [pytest.param(page, code, id=f"{page}-{number}") for page, number, code in blocks()],
)
def test_python_of_a_page(page, code, recorded, monkeypatch):
    """It runs as it is printed, but for the size of simulations and the length of runs."""
    monkeypatch.chdir(recorded)
    for (module, name), less in SHORTER.items():
        home = importlib.import_module(module)
        monkeypatch.setattr(home, name, with_values(getattr(home, name), less), raising=False)
    exec(compile(code, f"docs/{page}", "exec"), {})


def test_pages_have_python():
    """Blocks are found; those of import.md run in a test of their own."""
    assert {page for page, _, _ in blocks()} >= {"export.md", "library.md", "quick-start.md"}
    source = (Path(__file__).parent / "test_import_page.py").read_text(encoding="utf-8")
    assert all(f'"{name}"' in source for name in ELSEWHERE)
