"""The table of a sweep: means and spreads over seeds by scene and row, as Markdown and HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..evaluate import page
from ..evaluate.captioned import Picture
from .job import Result
from .plan import Job, Plan, Row, Scene
from .sheet import CLOSED_FORM

COLUMNS = {  # title: where it is in metrics.json
    "all": "d_mse_x100",
    "moving": "moving.d_mse_x100",
    "static": "static.d_mse_x100",
    "d_ToF": "d_tof_mse_x100",
    "chi-square": "explained.reduced_chi_square",
    "not explained": "explained.unexplained_share",
}
ERRORS = ("all", "moving", "static", "d_ToF")
COSTS = {"seconds": "seconds", "GPU MiB": "memory_mib", "Gaussians": "gaussians"}
UNIT = "mean squared errors of the distance along the ray x 100 [m^2]"
NONE = "-"
MARK = " *"  # behind the name of a row that is not all as published
OTHER_DATA = " (other data)"  # behind the name of what others published
NOT_APPLIED = "not applied: "
OVER = "over the closed form"


@dataclass(frozen=True, kw_only=True)
class Line:
    """A row of the table on one scene, or over all scenes."""

    scene: str
    """Name of the scene."""
    row: str
    """Name of the row."""
    cells: Mapping[str, str]
    """By the title of the column."""
    kind: str = ""
    """``ours``, ``closed`` or ``published``."""


def lines_of(plan: Plan, results: Mapping[str, Result]) -> list[Line]:
    """All lines: by scene the closed form, every row, and what others published."""
    lines: list[Line] = []
    good = _good(plan, results)
    for scene in plan.scenes:
        by_row = good[scene.name]
        every = [result for of_row in by_row.values() for result in of_row]
        if every:
            lines.append(_closed_form(scene, every[0]))
        for row in plan.rows:
            lines.append(
                _line(scene, row.name, by_row[row.name])
                if by_row[row.name]
                else _empty(scene, row.name, _why_not(plan, scene, row, results))
            )
        for name, errors in plan.published.items():
            if scene.name in errors:
                cells = dict(zip(("all", "d_ToF"), map(_three, errors[scene.name]), strict=False))
                title = name + OTHER_DATA
                lines.append(Line(scene=scene.name, row=title, cells=cells, kind="published"))
    return lines


def over_scenes(plan: Plan, results: Mapping[str, Result]) -> list[Line]:
    """Geometric means over the scenes of every error over that of the closed form."""
    lines, good = [], _good(plan, results)
    for row in plan.rows:
        cells = {}
        for title in ERRORS:
            ratios = [_ratio(by_row[row.name], title) for by_row in good.values()]
            known = [ratio for ratio in ratios if ratio]
            if known:
                mean = math.exp(sum(map(math.log, known)) / len(known))
                cells[title] = f"{mean:.3g}" + _of(len(known), len(ratios))
        lines.append(Line(scene=OVER, row=row.name, cells=cells, kind="ours"))
    return lines


def overview(plan: Plan, results: Mapping[str, Result]) -> list[list[str]]:
    """Rows by scenes, as the paper's tables have them: error of the distance and, in brackets, of
    d_ToF, geometric means over the closed form, and what a fit cost. A list of cells for each row,
    the first of titles.
    """
    every = lines_of(plan, results)
    cells: dict[str, dict[str, str]] = {line.row.removesuffix(MARK): {} for line in every}
    for line in [*every, *over_scenes(plan, results)]:
        cells[line.row.removesuffix(MARK)][line.scene] = _in_short(line)
    for name, costs in _costs(plan, results).items():
        cells[name] |= costs
    columns = [*(scene.name for scene in plan.scenes), OVER, "fits", *COSTS]
    marked = {line.row.removesuffix(MARK) for line in every if line.row.endswith(MARK)}
    ours = [name for name in cells if not name.endswith(OTHER_DATA)]
    rows = [
        [name + MARK if name in marked else name, *(cells[name].get(key, NONE) for key in columns)]
        for name in [*ours, *(name for name in cells if name.endswith(OTHER_DATA))]
    ]
    return [["d (d_ToF)", *columns], *rows]


def _costs(plan: Plan, results: Mapping[str, Result]) -> dict[str, dict[str, str]]:
    """Number of fits of every row, and means of what they cost."""
    good, costs = _good(plan, results), {}
    for row in plan.rows:
        fits = [result for by_row in good.values() for result in by_row[row.name]]
        costs[row.name] = {"fits": str(len(fits))} | _mean_costs(fits)
    return costs


def _in_short(line: Line) -> str:
    """Means of d and d_ToF, or why there are none."""
    given = line.cells.get("all", NONE).removeprefix(NOT_APPLIED)
    if "d_ToF" not in line.cells:
        return given.split(" (")[0]
    return f"{given.split(' (')[0]} ({line.cells['d_ToF'].split(' (')[0]})"


def _why_not(plan: Plan, scene: Scene, row: Row, results: Mapping[str, Result]) -> str:
    """In a few words why a row has no numbers; empty if no job of it states why."""
    for seed in plan.seeds:
        result = results.get(Job(scene=scene, row=row, seed=seed).id, {})
        if "refused" in result:
            return NOT_APPLIED + result["refused"]
        if "error" in result:
            return "failed"
    return ""


def refusals(results: Iterable[Result]) -> list[str]:
    """Methods that cannot be applied to a scene, a line each."""
    return [
        f"{result['scene']}, {result['row']}: {result['refused']}: {result['why']}"
        for result in results
        if "refused" in result
    ]


def failures(results: Iterable[Result]) -> list[str]:
    """What failed, a line each."""
    return [f"{result['id']}: {result['error']}" for result in results if "error" in result]


def assumptions(plan: Plan, results: Mapping[str, Result]) -> list[str]:
    """What of the rows was not published, or is done in another way: a line for each statement,
    after the names of its rows. A row without such a statement is not named.
    """
    rows: dict[str, dict[str, None]] = {}
    for job in plan.fits:
        for sentence in results.get(job.id, {}).get("assumed", ()):
            if job.row is not None:
                rows.setdefault(sentence, {})[job.row.name] = None
    return [f"{', '.join(names)}: {sentence}" for sentence, names in rows.items()]


def exit_code(results: Iterable[Result]) -> int:
    """0 if every job is done, else the largest exit code of those that failed."""
    return max((result["exit_code"] for result in results if "error" in result), default=0)


def markdown(plan: Plan, results: Mapping[str, Result]) -> str:
    """The table as Markdown, with what failed."""
    titles = ["scene", "row", *COLUMNS, *COSTS]
    short = overview(plan, results)
    text = [f"{_about(plan)}\n", _row(short[0]), _row(["---"] * len(short[0]))]
    text += [*map(_row, short[1:]), "", _row(titles), _row(["---"] * len(titles))]
    for line in [*lines_of(plan, results), *over_scenes(plan, results)]:
        cells = (line.cells.get(title, NONE) for title in [*COLUMNS, *COSTS])
        text.append(_row([line.scene, line.row, *cells]))
    text += ["", *(f"* {note}" for note in assumptions(plan, results))]
    text += [f"\nnot applied: {refusal}" for refusal in refusals(results.values())]
    text += [f"\nfailed: {failure}" for failure in failures(results.values())]
    return "\n".join(text) + "\n"


def html(plan: Plan, results: Mapping[str, Result], sheets: Mapping[str, Picture | None]) -> str:
    """The tables as an offline page, with the picture of every scene."""
    body = "<header><h1>Sweep</h1></header>"
    about = page.caption(page.escape(_about(plan)))
    head, *short = overview(plan, results)
    body += page.section(
        "All scenes", about, page.table(head, [("", list(map(page.escape, row))) for row in short])
    )
    body += page.section("Over the closed form", _html(over_scenes(plan, results), ERRORS))
    if failed := failures(results.values()):
        items = "".join(f"<li>{page.escape(failure)}</li>" for failure in failed)
        body += page.section("What failed", f"<ul>{items}</ul>")
    if refused := refusals(results.values()):
        items = "".join(f"<li>{page.escape(refusal)}</li>" for refusal in refused)
        body += page.section("What cannot be applied", f"<ul>{items}</ul>")
    lines = lines_of(plan, results)
    for scene in plan.scenes:
        of_scene = [line for line in lines if line.scene == scene.name]
        picture = sheets.get(scene.name)
        shown = "" if picture is None else page.plain_picture(picture, scene.name, "all rows")
        body += page.section(page.escape(scene.name), _html(of_scene, [*COLUMNS, *COSTS]), shown)
    if notes := assumptions(plan, results):
        listed = "".join(f"<li>{page.escape(note)}</li>" for note in notes)
        body += page.section("Not as published (*)", f"<ul>{listed}</ul>")
    return page.document("Sweep", body)


def _html(lines: Iterable[Line], titles: Iterable[str]) -> str:
    """Lines of one scene as a table."""
    titles = list(titles)
    rows = [(ln.kind, [ln.row, *(ln.cells.get(title, NONE) for title in titles)]) for ln in lines]
    return page.table(
        ["", *titles], [(kind, [page.escape(cell) for cell in cells]) for kind, cells in rows]
    )


def _about(plan: Plan) -> str:
    seeds = ", ".join(map(str, plan.seeds))
    images = "" if plan.images is None else f", {plan.images} images per fit"
    return (
        f"{UNIT}; means over seeds {seeds}, with the least and the largest{images}; scored raw "
        f"frames: {plan.frames}. Over the closed form: geometric means over scenes."
    )


def _good(plan: Plan, results: Mapping[str, Result]) -> dict[str, dict[str, list[Result]]]:
    """Good results by scene and row, one per seed."""
    good: dict[str, dict[str, list[Result]]] = {
        scene.name: {row.name: [] for row in plan.rows} for scene in plan.scenes
    }
    for job in plan.fits:
        result = results.get(job.id)
        if job.row is not None and result and "metrics" in result:
            good[job.scene.name][job.row.name].append(result)
    return good


def _closed_form(scene: Scene, result: Result) -> Line:
    keys = {title: COLUMNS[title].replace("d_mse", "closed_form_mse") for title in ERRORS[:3]}
    values = {title: page.look_up(result["metrics"], key) for title, key in keys.items()}
    cells = {title: f"{value:.3g}" for title, value in values.items() if value is not None}
    return Line(scene=scene.name, row=CLOSED_FORM, cells=cells, kind="closed")


def _line(scene: Scene, name: str, results: Sequence[Result]) -> Line:
    cells = {}
    for title, key in COLUMNS.items():
        percent = title == "not explained"
        values = [page.look_up(result["metrics"], key) for result in results]
        if text := _spread([100.0 * v if percent else v for v in values if v is not None]):
            cells[title] = text + (" %" if percent else "")
    cells |= _mean_costs(results)
    marked = name + MARK if any(result.get("assumed") for result in results) else name
    return Line(scene=scene.name, row=marked, cells=cells, kind="ours")


def _mean_costs(results: Sequence[Result]) -> dict[str, str]:
    """By the title of the column."""
    cells = {}
    for title, key in COSTS.items():
        values = [result[key] for result in results if result.get(key) is not None]
        if values:
            cells[title] = f"{np.mean(values):{'.1f' if title == 'seconds' else '.0f'}}"
    return cells


def _empty(scene: Scene, name: str, why: str) -> Line:
    """A row without a result."""
    return Line(scene=scene.name, row=name, cells={"all": why} if why else {}, kind="ours")


def _spread(values: Sequence[float]) -> str:
    """The mean, and the least and the largest value if there are several that differ."""
    if not values:
        return ""
    mean, low, high = (f"{f(values):.3g}" for f in (np.mean, np.min, np.max))
    return mean if low == high else f"{mean} ({low} to {high})"


def _ratio(results: Sequence[Result], title: str) -> float | None:
    """Mean error over seeds over that of the closed form on the same pixels; None: not known."""
    key = COLUMNS[title]
    below = key.replace("d_tof_mse", "closed_form_mse").replace("d_mse", "closed_form_mse")
    pairs = [[page.look_up(r["metrics"], k) for k in (key, below)] for r in results]
    known = [(above, under) for above, under in pairs if above is not None and under]
    return sum(a for a, _ in known) / sum(b for _, b in known) if known else None


def _three(value: float) -> str:
    return f"{value:.3g}"


def _of(known: int, scenes: int) -> str:
    return "" if known == scenes else f" (of {known})"


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
