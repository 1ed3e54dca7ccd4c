"""One picture of a scene: the distance of every row of a sweep, and its error below."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..evaluate import pictures
from ..evaluate.captioned import IN_A_ROW, Panel, Picture, captioned
from .job import Result, picture_of
from .plan import Job, Plan, Scene

CLOSED_FORM = "closed form"
IN_A_LINE = 5  # [pictures] then the next line begins
SIZE_MAX = 320  # [px] of an image
ERROR_MIN = 0.05  # [1] of the range of distances that the scale of errors has at least


def sheet(plan: Plan, scene: Scene, out: Path, results: Mapping[str, Result]) -> Picture | None:
    """Truth, closed form and all rows that are scored, with their first seed; None without any.

    All distances have one colour scale and all errors another, those of truth and closed form.
    """
    jobs = {row.name: Job(scene=scene, row=row, seed=plan.seeds[0]) for row in plan.rows}
    images = {
        name: stored
        for name, job in jobs.items()
        if "metrics" in results.get(job.id, {}) and (stored := _stored(picture_of(job, out)))
    }
    if not images:
        return None
    first = next(iter(images.values()))
    distances = {"truth": first["truth"]} if "truth" in first else {}
    distances |= {CLOSED_FORM: first["closed_form"]} | {k: v["d"] for k, v in images.items()}
    errors = {k: v["error"] for k, v in images.items() if "error" in v}
    if "closed_form_error" in first:
        errors = {CLOSED_FORM: first["closed_form_error"]} | errors
    scale = pictures.distance_scale([next(iter(distances.values()))])
    error_scale = None
    if CLOSED_FORM in errors:  # which may be right in nearly all pixels
        least = ERROR_MIN * (scale.high - scale.low)
        error_scale = pictures.error_scale([errors[CLOSED_FORM]], least)
    lines, names = [], list(distances)
    for k in range(0, len(names), IN_A_LINE):
        some = names[k : k + IN_A_LINE]
        panels = [_panel(name, distances[name], scale) for name in some]
        lines.append(captioned(panels, f"{scene.name}: distance [m]", IN_A_ROW))
        if error_scale is not None:
            panels = [_panel(name, _error(errors, distances, name), error_scale) for name in some]
            lines.append(captioned(panels, f"{scene.name}: |error| [m]", IN_A_ROW))
    return _stacked(lines)


def _stored(path: Path) -> dict[str, Float[np.ndarray, "H W"]]:
    """Images of a job; none if it has no file."""
    if not path.is_file():
        return {}
    with np.load(path) as stored:
        return {name: stored[name].astype(np.float32) for name in stored.files}


def _error(
    errors: Mapping[str, Float[np.ndarray, "H W"]],
    distances: Mapping[str, Float[np.ndarray, "H W"]],
    name: str,
) -> Float[np.ndarray, "H W"]:
    """Error of a column; of the truth it is 0."""
    return errors[name] if name in errors else np.zeros_like(distances[name])


def _panel(name: str, image: Float[np.ndarray, "H W"], scale: pictures.Scale) -> Panel:
    small = pictures.thinned(image, SIZE_MAX)
    return Panel(name, pictures.colour_mapped(small.copy(), scale), scale)


def _stacked(lines: list[Picture]) -> Picture:
    """Pictures below one another, on white."""
    width = max(line.shape[1] for line in lines)
    wide = [
        np.pad(line, ((0, 0), (0, width - line.shape[1]), (0, 0)), constant_values=pictures.WHITE)
        for line in lines
    ]
    return np.concatenate(wide)
