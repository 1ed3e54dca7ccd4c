"""Tables of benchmarks/accuracy.py: fits of many scenes with several seeds as Markdown.

Every error is a mean squared error of the distance [m^2] times 100 over all scored raw frames, from
`gftorf compare`. A ratio is an error of d over that of the closed form, or of another row there, on
the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from gftorf_warp.recon.residuals import problems

Result = dict[str, Any]
PARTS = ("all", "moving", "static")
MOVING_CLASSES = ("moving interior", "moving edge")
STATIC_CLASSES = ("static interior", "static edge")
NONE = "-"
SUMMARY = (
    "row", "d / closed form", "fit alone, measured", "median", "d_ToF", "d / temporal",
    "moving interior / edge, static", "static interior, throughout", "worst scene",
    "worse than closed form", "than temporal", "seeds max / min", "rise",
    "chi-square, unexplained", "repeated, warned, unnoticed", "seconds", "Gaussians", "failed",
)  # fmt: skip


def error_of(result: Result, distance: str, part: str) -> float | None:
    """Error of a distance (``d``, ``d_tof``, ``closed_form``, ``temporal``) on ``all``, ``moving``
    or ``static`` pixels, ``static_throughout`` the sequence, or a class like ``static edge``.
    """
    scores = result["scores"]
    group, _, kind = part.partition(" ")
    if kind:
        scores = ((scores.get("classes") or {}).get(group) or {}).get(kind) or {}
    elif part != "all":
        scores = scores.get(part) or {}
    error = scores.get(f"{distance}_mse_x100")
    # without measurements that replace it, all of d is the fit's
    return error_of(result, "d", part) if distance == "d_fit" and error is None else error


def ratio(
    result: Result, part: str, distance: str = "d", over: str = "closed_form"
) -> float | None:
    """Error over that of another distance; None where there is no such pixel or distance."""
    error, other = (error_of(result, name, part) for name in (distance, over))
    return error / other if error is not None and other else None


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Of those that are known and above 0; None without any."""
    logarithms = [math.log(value) for value in values if value]
    return math.exp(float(np.mean(logarithms))) if logarithms else None


def worse(result: Result, over: str = "closed_form") -> bool:
    """Whether d is worse than another distance on all, moving or static pixels."""
    return any((ratio(result, part, over=over) or 0.0) > 1.0 for part in PARTS)


def warned(result: Result) -> bool:
    """Whether the fit said by itself that something is wrong."""
    return bool(problems(result["scores"].get("explained")))


def unnoticed(result: Result) -> bool:
    """Whether the fit alone is worse than the closed form over all pixels, and did not say so."""
    return (ratio(result, "all", "d_fit") or 0.0) > 1.0 and not warned(result)


def by_scene(results: Iterable[Result]) -> dict[str, list[Result]]:
    """Results of each scene, in the order of the first ones."""
    grouped: dict[str, list[Result]] = {}
    for result in results:
        grouped.setdefault(result["scene"], []).append(result)
    return grouped


def scene_mean(results: Iterable[Result], value: Callable[[Result], float | None]) -> float | None:
    """Geometric mean over scenes of the geometric mean over seeds."""
    each = by_scene(results).values()
    return geometric_mean(geometric_mean(map(value, fits)) for fits in each)


def worst_first(results: Iterable[Result]) -> list[Result]:
    """Fits by their largest ratio of all, moving and static pixels."""
    return sorted(results, key=lambda fit: -max(ratio(fit, part) or 0.0 for part in PARTS))


def summary(rows: Sequence[str], scenes: Sequence[Result], results: Sequence[Result]) -> str:
    """A line for each row, over all scenes, below one for the edge floor."""
    floors = [_floor_as_fit(scene, results) for scene in scenes]
    known = [floor for floor in floors if floor is not None]
    lines = [["edge floor", *_line(known), NONE]] if known else []
    for row in rows:
        mine = [result for result in results if result.get("row") == row]
        fits = [result for result in mine if "error" not in result]
        lines.append([row, *_line(fits), str(len(mine) - len(fits))])
    return _table(SUMMARY, lines)


def _floor_as_fit(scene: Result, results: Iterable[Result]) -> Result | None:
    """A fit whose d is wrong by the edge floor alone; None if floor or closed form is unknown."""
    of_scene = (each for each in results if each["scene"] == scene["scene"] and "scores" in each)
    fit, floor = next(of_scene, None), scene.get("floor")
    if fit is None or not floor:
        return None
    scores: dict[str, Any] = {}
    for part in PARTS:
        kept = {
            f"{name}_mse_x100": error_of(fit, name, part) for name in ("closed_form", "temporal")
        }
        scores[part] = {**kept, "d_mse_x100": floor[part]}
    return {"scene": scene["scene"], "scores": scores | scores.pop("all")}


def _line(fits: list[Result]) -> list[str]:
    if not fits:
        return [NONE] * (len(SUMMARY) - 2)
    scenes = by_scene(fits)
    means = {
        name: geometric_mean(ratio(fit, "all") for fit in each) for name, each in scenes.items()
    }
    worst = max(means, key=lambda name: means[name] or 0.0)
    spreads = [_spread(each) for each in scenes.values()]
    known = [spread for spread in spreads if spread is not None]
    explained = [fit["scores"].get("explained") or {} for fit in fits]
    chi = geometric_mean(each.get("reduced_chi_square") for each in explained)
    shares = [share for each in explained if (share := each.get("unexplained_share")) is not None]
    sources = [fit["scores"].get("source") for fit in fits]
    measured = [1.0 - source["fit"] if source else 0.0 for source in sources]
    rises = [rise for fit in fits if (rise := fit.get("rise"))]
    seconds = [fit["seconds"] for fit in fits if "seconds" in fit]

    def means_of(distance: str, over: str, parts: Iterable[str] = PARTS) -> str:
        return _three(
            *(
                scene_mean(fits, lambda fit, part=part: ratio(fit, part, distance, over))
                for part in parts
            )
        )

    def worse_than(over: str) -> str:
        bad = [fit for fit in fits if worse(fit, over)]
        scenes_of = f"{len(by_scene(bad))} of {len(scenes)} scenes"
        return f"{scenes_of}, {len(bad)} of {len(fits)} fits"

    return [
        means_of("d", "closed_form"),
        f"{means_of('d_fit', 'closed_form')}, {100 * np.mean(measured):.2g} %"
        if any(sources)
        else NONE,
        means_of("d_median", "closed_form"),
        means_of("d_tof", "closed_form"),
        means_of("d", "temporal"),
        f"{means_of('d', 'closed_form', MOVING_CLASSES)}, "
        f"{means_of('d', 'closed_form', STATIC_CLASSES)}",
        f"{means_of('d', 'temporal', ['static interior'])}, "
        f"{means_of('d', 'temporal_mean', ['static_throughout'])}",
        f"{worst} {_number(means[worst])}",
        worse_than("closed_form"),
        worse_than("temporal"),
        f"{_number(geometric_mean(known))}, {_number(max(known))}" if known else NONE,
        f"{np.median(rises):.3g}, {max(rises):.3g}" if rises else NONE,
        f"{_number(chi)}, {100 * np.mean(shares):.2g} %" if shares else NONE,
        f"{sum(fit.get('attempts', 1) > 1 for fit in fits)}, {sum(map(warned, fits))}, "
        f"{sum(map(unnoticed, fits))}",
        f"{np.median(seconds):.1f}, {max(seconds):.1f}" if seconds else NONE,
        f"{int(np.median([fit['gaussians'] for fit in fits]))}" if seconds else NONE,
    ]


def _spread(fits: list[Result]) -> float | None:
    """Largest over smallest error of d among the seeds of a scene; None with a single seed."""
    errors = [error for fit in fits if (error := error_of(fit, "d", "all"))]
    return max(errors) / min(errors) if len(errors) > 1 else None


def details(rows: Sequence[str], scenes: Sequence[Result], results: Sequence[Result]) -> str:
    """A line for each scene: closed form, edge floor, and d of every row, mean over seeds."""
    lines = []
    for scene in scenes:
        mine = [result for result in results if result["scene"] == scene["scene"]]
        fits = [result for result in mine if "error" not in result]
        floor = scene.get("floor") or {}
        line = [scene["scene"], scene.get("about", "")]
        line.append(_errors(fits[:1], "closed_form"))
        line.append(_three(*(floor.get(part) for part in PARTS)) if floor else NONE)
        for row in rows:
            each = [fit for fit in fits if fit["row"] == row]
            mark = " **worse**" if any(map(worse, each)) else ""
            failed = any("error" in result for result in mine if result.get("row") == row)
            line.append(_errors(each, "d") + mark + (" **failed**" if failed else ""))
        lines.append(line)
    return _table(("scene", "", "closed form", "edge floor", *rows), lines)


def _errors(fits: Sequence[Result], distance: str) -> str:
    def mean(part: str) -> float | None:
        errors = [error for fit in fits if (error := error_of(fit, distance, part)) is not None]
        return float(np.mean(errors)) if errors else None

    return _three(*map(mean, PARTS)) if fits else NONE


def failures(results: Iterable[Result]) -> str:
    """What failed, a line each; empty if nothing did."""
    lines = [f"* {each['id']}: {each['error']}" for each in results if "error" in each]
    return "\n".join(["Failed:", "", *lines, ""]) if lines else ""


def _three(*values: float | None) -> str:
    return " / ".join(map(_number, values))


def _number(value: float | None) -> str:
    if value is None:
        return NONE
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
