"""Every command at small size, for benchmarks that take memory or disk space away from it."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gftorf_warp.cli import main
from gftorf_warp.recon import checkpoint

DEVICE = ["--device", "cpu", "-q"]
FIT = ["--preset", "demo", *DEVICE]
PLAN = """
scenes = ["demo"]
presets = ["demo", "ctof"]
images = 16
[simulate]
size = [{width}, {height}]
frames = {frames}
"""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command, and how it is made possible again."""

    words: list[str]
    """Its arguments."""
    written: Path | None = None
    """What it writes and may not find; None: nothing."""
    before: Callable[[], object] = lambda: None
    """Called before it, after ``written`` was removed."""
    run: Path | None = None
    """A run, or a folder of runs, whose newest checkpoints must always load; None: none."""

    def reset(self) -> None:
        """As before the command."""
        if self.written is not None and self.written.is_dir():
            shutil.rmtree(self.written)
        elif self.written is not None:
            self.written.unlink(missing_ok=True)
        self.before()

    def loads(self) -> bool:
        """Whether the newest checkpoint of each of its runs loads, if it has any."""
        stored = [] if self.run is None else [*self.run.rglob("ckpt")]
        for folder in stored:
            checkpoint.last(folder.parent)  # raises if it does not
        return not any([*folder.glob(".*.tmp-*")] for folder in stored)


def commands(inputs: Path, place: Path, size: str, frames: int) -> dict[str, Command]:
    """All by name. Makes what they need below ``inputs``; they write below ``place``."""
    seq, run, other = (str(inputs / name) for name in ("seq", "run", "other"))
    recorded = ["simulate", "demo", "--size", size, "--frames", str(frames), "-q", "--out"]
    fitted = ["reconstruct", seq, *FIT, "--images"]
    plan, (width, height) = inputs / "plan.toml", size.split("x")
    plan.write_text(PLAN.format(width=width, height=height, frames=frames))
    for words in (
        [*recorded, seq],
        [*fitted, "8", "--out", run],
        [*fitted, "8", "--seed", "1", "--out", other],
    ):
        assert quiet(words) == 0
    words = {
        "simulate": recorded[:-1],
        "import": ["import", "ftorf", seq, "-q"],
        "reconstruct": [*fitted, "8"],
        "render": ["render", run, *DEVICE],
        "export": ["export", run, "--format", "ply,points,mesh,exr,npz,html,gif", *DEVICE],
        "compare, two runs": ["compare", run, other, *DEVICE],
        "sweep": ["sweep", str(plan), "--workers", "1", *DEVICE],
    }
    found = {
        name: Command(
            words=[*given, "--out", str(place / given[0])],
            written=place / given[0],
            run=place / given[0] if name in ("reconstruct", "sweep") else None,
        )
        for name, given in words.items()
    }
    longer = place / "longer"
    of_longer = {"written": longer, "before": lambda: shutil.copytree(run, longer), "run": longer}
    found["reconstruct, longer"] = Command(words=[*fitted, "16", "--out", str(longer)], **of_longer)
    found["compare"] = Command(words=["compare", str(longer), *DEVICE], **of_longer)
    found["check"] = Command(words=["check", seq, "-q"])
    return found


def quiet(words: list[str]) -> int:
    """Exit code of a command whose output is dropped."""
    sink = io.StringIO()
    with contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        return main(words)
