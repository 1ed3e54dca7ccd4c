"""Scripts of examples/ with what they print, and contact sheets of scenes, made at build time."""

import ast
import contextlib
import io
import runpy
import shutil
import sys
import tempfile
from pathlib import Path
from unittest import mock

from gftorf_warp import simulate
from gftorf_warp.data.write import SHEET

EXAMPLES = Path(__file__).parents[1] / "examples"
SLOW = ("05_reconstruct", "06_moving_camera")  # shown, but not run at every build
SCENES = ("sliding", "arc", "tour", "speed_test_chair", "pillow", "random-7")


def write(folder: Path) -> None:
    """Write examples.md and a contact sheet of each scene into ``folder``."""
    text = "# Examples in Python\n\nThe scripts of `examples/`, with what they print.\n"
    text += "".join(section(path) for path in sorted(EXAMPLES.glob("*.py")))
    (folder / "examples.md").write_text(text, encoding="utf-8")
    with tempfile.TemporaryDirectory() as temporary:
        for name in SCENES:
            path = simulate(name, Path(temporary) / name, frames=12, size=(128, 96), engine="mesh")
            shutil.copyfile(path / SHEET, folder / f"scene-{name}.png")


def section(path: Path) -> str:
    """Docstring, source and output of one script."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    source = f"../../examples/{path.name}\n:language: python\n:lines: {tree.body[1].lineno}-"
    text = f"\n## {path.name}\n\n{ast.get_docstring(tree)}\n\n```{{literalinclude}} {source}\n```\n"
    return text if path.stem in SLOW else f"{text}\n```\n{printed(path)}```\n"


def printed(path: Path) -> str:
    """Standard output of a script, run in a folder that is removed afterwards."""
    output = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(output),
        mock.patch.object(sys, "argv", [str(path)]),
    ):
        runpy.run_path(str(path), run_name="__main__")
    return output.getvalue()
