"""``gftorf compare RUN RUN ...``: several runs of one sequence, as numbers and as an offline
page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..data.files import atomic_write, write_json
from ..errors import InputError, UsageError
from . import page, panels, runs_page
from .compare import score, sequence_title
from .panels import Comparison
from .runs_page import Scored

if TYPE_CHECKING:
    from ..recon.run import Run

NUMBERS, PAGE = "comparison.json", "comparison.html"
OTHERS = (runs_page.CLOSED_FORM, runs_page.TRUTH)
COLUMNS = {  # title of a column of the printed table: key of metrics.json, how it is printed
    "all": ("d_mse_x100", ".4g"),
    "moving": ("moving.d_mse_x100", ".4g"),
    "static": ("static.d_mse_x100", ".4g"),
    "quad PSNR": ("quad_psnr_db", ".2f"),
    "chi-square": ("explained.reduced_chi_square", ".3g"),
    "Gaussians": ("gaussians", "d"),
    "seconds": ("seconds_reconstruct", ".1f"),
}


def compare_runs(
    runs: Sequence[Run],
    out: str | Path,
    *,
    truth: str | Path | None = None,
    frames: str = "all",
    against: str = "geometry",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Score runs of one sequence and write ``OUT/comparison.json`` and ``OUT/comparison.html``.

    Nothing is written into the folders of the runs. Arguments are those of
    :func:`gftorf_warp.evaluate.compare.compare`; ``progress`` counts the steps of all runs.

    Returns:
        The content of comparison.json: the sequence and its SHA-256, and the metrics.json of every
        run by its name.

    Raises:
        UsageError: If a run is named twice, or ``frames`` or ``against`` is unknown.
        InputError: If the runs are not of one sequence, or one cannot be read.
        DivergedError: If a rendering is not finite.
        ResourceError: If the disk is full.
    """
    names = names_of([run.path for run in runs])
    check_same_data(runs)
    scored, first = [], None
    for k, run in enumerate(runs):
        metrics, comparison = score(
            run, truth=truth, frames=frames, against=against, progress=_of_all(progress, k, runs)
        )
        first = first or comparison
        scored.append(_scored(names[k], run.config, metrics, comparison))
    assert first is not None, "there are runs"
    path, config = first.sequence.path, runs[0].config
    result = {
        "version": __version__,
        "sequence": None if path is None else str(path),
        "data_sha256": config.get("data_sha256"),
        "runs": {one.name: one.metrics for one in scored},
    }
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / NUMBERS, result)
    title = f"{len(runs)} runs of {sequence_title(path) or 'a sequence'}"
    atomic_write(out / PAGE, runs_page.page_of(title, first, scored).encode("utf-8"))
    return result


def names_of(paths: Sequence[Path]) -> list[str]:
    """The last parts of each path, as few as distinguish all of them, and from what else the page
    shows.

    Raises:
        UsageError: If two are one folder.
    """
    parts = [path.resolve().parts for path in paths]
    for k, path in enumerate(paths):
        if parts[k] in parts[:k]:
            why, fix = "comparing a run with itself shows nothing", "name every run once"
            raise UsageError("a run is named twice", where=path, why=why, fix=fix)
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len({*names, *OTHERS}) == len(names) + len(OTHERS):
            break
    return names


def check_same_data(runs: Sequence[Run]) -> None:
    """Check by the hashes of their data that runs are of one sequence, else by its folder.

    Raises:
        InputError: If they are not.
    """
    first, *others = runs
    for run in others:
        first_data, run_data = (one.config.get("data_sha256") for one in (first, run))
        if first_data is None or run_data is None:  # runs of before 0.1.0
            first_data, run_data = (_folder_of(one) for one in (first, run))
        if first_data == run_data:
            continue
        why = (
            f"{first.path} was made from {_folder_of(first)} ({str(first_data)[:12]}...), this one "
            f"from {_folder_of(run)} ({str(run_data)[:12]}...)"
        )
        fix = "compare runs of one sequence, and others with `gftorf compare RUN` one by one"
        raise InputError("runs of different sequences", where=run.path, why=why, fix=fix)


def table_of_runs(result: Mapping[str, Any]) -> str:
    """comparison.json in lines: errors (MSE x100 [m^2]) and what else there is of every run."""
    runs = result["runs"]
    first = next(iter(runs.values()))
    width = max(16, *map(len, runs)) + 2
    lines = [f"{'MSE x100 [m^2]':<{width}}" + "".join(f"{title:>12}" for title in COLUMNS)]
    for name in ("closed_form", "temporal"):
        keys = [key for key, _ in COLUMNS.values() if key.endswith("d_mse_x100")]
        cells = [_cell(first, key.replace("d_mse", f"{name}_mse"), ".4g") for key in keys]
        lines.append(f"{name.replace('_', ' '):<{width}}" + "".join(f"{c:>12}" for c in cells))
    for name, metrics in runs.items():
        cells = [_cell(metrics, key, form) for key, form in COLUMNS.values()]
        lines.append(f"{name:<{width}}" + "".join(f"{cell:>12}" for cell in cells))
    scored = f"{first['frames']} raw frames ({first['protocol']}), against {first['against']}"
    return "\n".join([*lines, scored])


def _of_all(
    progress: Callable[[int, int], None] | None, k: int, runs: Sequence[Run]
) -> Callable[[int, int], None] | None:
    """Progress of the k-th run as a part of all."""
    if progress is None:
        return None
    return lambda done, total: progress(k * total + done, len(runs) * total)


def _scored(
    name: str, config: Mapping[str, Any], metrics: Mapping[str, Any], comparison: Comparison
) -> Scored:
    judged, chi_square = comparison.judgement, None
    if comparison.residuals is not None and comparison.residuals.noisy:
        shown = comparison.views.frames[panels.row_to_show(comparison)] // comparison.sequence.cycle
        chi_square = comparison.residuals.chi_square[comparison.residuals.quartets.index(shown)]
    return Scored(
        name=name,
        config=config,
        metrics=metrics,
        d=comparison.views.d,
        error=None if judged is None else judged.errors["d"],
        chi_square=chi_square,
    )


def _folder_of(run: Run) -> str:
    source = run.config.get("sequence")
    return "a sequence in memory" if source is None else str(Path(source).resolve())


def _cell(metrics: Mapping[str, Any], key: str, form: str) -> str:
    value = page.look_up(metrics, key)
    return "-" if value is None else f"{value:{form}}"
