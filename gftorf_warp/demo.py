"""``gftorf demo``: simulate a moving scene, check it, reconstruct it, compare."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from . import __version__
from .errors import UsageError
from .terminal import LOG

SCENE = "demo"
PRESET = "best"
SETTINGS = "demo.json"
OURS = (SETTINGS, "seq", "run", "metrics.json", "report.html")


def demo(
    out: str | Path,
    *,
    device: str = "cpu",
    seed: int = 0,
    size: tuple[int, int] | None = None,
    frames: int | None = None,
    images: int | None = None,
    fresh: bool = False,
    progress: Callable[[str], Callable[..., None]] | None = None,
) -> list[str]:
    """Run the four steps in one folder; finished steps with the same settings are not repeated.

    Args:
        out: Folder to write: ``seq``, ``run``, ``metrics.json``, ``report.html``.
        device: Device of the reconstruction.
        seed: Of the sensor's noise and of the optimiser.
        size: (width, height) [px]; None is the scene's own.
        frames: Raw frames; None is the scene's own number.
        images: Raw frames to optimise; None is the preset's own number.
        fresh: Start over; an earlier demo in ``out`` is moved to ``out/old-1``, ``old-2``, ...
        progress: Called with the name of a step; returns its progress callback (done, total).

    Returns:
        Lines to print: errors on moving and on static pixels, and the path of the report.

    Raises:
        UsageError: If ``out`` holds other files, or, without ``fresh``, a demo with other settings.
    """
    from .data.check import check
    from .data.read import read
    from .evaluate.compare import compare
    from .recon.train import reconstruct
    from .sim.simulate import simulate

    out = Path(out)
    chosen = {"seed": seed, "size": size, "frames": frames, "images": images}
    prepare(out, {"version": __version__, **chosen}, fresh=fresh)

    def report(label: str) -> Callable[..., None] | None:
        return None if progress is None else progress(label)

    with _Step("[1/4] simulate   ") as step:
        path = simulate(
            SCENE, out / "seq", frames=frames, size=size, seed=seed, progress=report("simulate")
        )
        sequence = read(path)
        size_of = f"{sequence.width}x{sequence.height}, {sequence.frames} raw frames"
        step.result = f"{SCENE} {size_of} -> {out / 'seq'}"
    with _Step("[2/4] check      ") as step:
        checked = check(out / "seq")
        for line in checked.lines:
            LOG.debug("      %s", line)
        for line in checked.warnings:
            LOG.warning(line)
        frequency = f"{sequence.calibration.f_mod_hz / 1e6:.2f} MHz"
        step.result = f"{len(sequence.complete_quartets)} complete quartets at {frequency}"
    with _Step("[3/4] reconstruct") as step:
        shown = report("reconstruct")
        given = sequence, out / "run", PRESET
        run = reconstruct(*given, images=images, seed=seed, device=device, progress=shown)
        step.result = f"{run.gaussians} Gaussians -> {out / 'run'}"
    with _Step("[4/4] compare    ") as step:
        metrics = compare(run, progress=report("compare"))
        for name in ("metrics.json", "report.html"):
            shutil.copyfile(run.path / name, out / name)
        step.result = f"{metrics['frames']} raw frames scored -> {out / 'metrics.json'}"
    return [*summary(metrics), f"open {out / 'report.html'} (one file, works offline)"]


def prepare(out: Path, settings: dict, *, fresh: bool) -> None:
    """Store the settings in ``out``, which must be empty or hold a demo with the same ones.

    Raises:
        UsageError: If it holds other files, or, without ``fresh``, a demo with other settings.
    """
    from .data.texts import read_json
    from .recon.folder import set_aside

    wanted = json.loads(json.dumps(settings))  # tuples become lists, as they are on disk
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        path = out / SETTINGS
        stored = read_json(path) if path.is_file() else None
        fix = "choose another --out, or --fresh, which moves its content to old-1"
        if stored is None:
            why, fix = f"it has no {SETTINGS}: no demo has begun in it", "choose another --out"
            raise UsageError("the folder is not empty", where=out, why=why, fix=fix)
        if fresh:
            moved = set_aside(out, [out / n for n in OURS if (out / n).exists()])
            LOG.info("the earlier demo is now in %s", moved)
        elif stored != wanted:
            known = stored if isinstance(stored, dict) else {}
            differ = ", ".join(key for key in wanted if known.get(key) != wanted[key])
            why = f"it was made with another {differ}"
            raise UsageError("the folder is not empty", where=out, why=why, fix=fix)
    out.mkdir(parents=True, exist_ok=True)
    (out / SETTINGS).write_text(json.dumps(wanted, indent=2) + "\n")


def summary(metrics: dict) -> list[str]:
    """Errors of the closed form and of ours, from metrics.json, on moving and on static pixels."""
    lines = []
    for name in ("moving", "static"):
        row = metrics[name]
        if row is None or row["d_mse_x100"] is None:
            lines.append(f"{name} pixels: none in this scene")
            continue
        closed_form, ours = row["closed_form_mse_x100"], row["d_mse_x100"]
        lines.append(
            f"{name} pixels: closed form {closed_form:.3f} -> ours {ours:.3f} "
            f"(distance error, MSE x100 [m^2]; {ours / closed_form:.2f} of it)"
        )
    return lines


class _Step:
    """Times one of the four steps and logs its result at the end."""

    def __init__(self, name: str):
        self.name, self.result = name, ""

    def __enter__(self) -> _Step:
        self.start = time.monotonic()
        LOG.info(self.name.rstrip())
        return self

    def __exit__(self, kind, *_) -> None:
        if kind is None:
            LOG.info("%s %s   %.1f s", self.name, self.result, time.monotonic() - self.start)
