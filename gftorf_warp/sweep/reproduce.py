"""``gftorf reproduce``: a stated result once more, and whether it lies within its spread.

results.toml has a row for each: what was simulated and fitted with which seeds, and an error
per seed. A row is done again as a sweep of one scene and one preset. With v the mean of the stated
errors, and s the largest deviation of a seed from it, a measured mean m is within the spread if

    |m - v| <= max(2 s, 0.02 v),

or, of rows that state the mean of all seeds alone, ``spread`` v in place of this maximum.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..data.texts import read_toml
from ..errors import GftorfError, UsageError
from ..evaluate.page import look_up
from ..similar import did_you_mean
from .command import sweep
from .plan import Plan, Row, Scene

FILE = Path(__file__).with_name("results.toml")
BEYOND = 2.0  # deviations: of three seeds, the largest is about one standard deviation
LEAST = 0.02  # [1] of a value, by which results of one seed differ from processor to processor
UNIT = "MSE x 100 [m^2]"
TITLES = {
    "closed_form_mse_x100": "closed form, all",
    "moving.closed_form_mse_x100": "closed form, moving",
    "static.closed_form_mse_x100": "closed form, static",
    "d_mse_x100": "d, all",
    "moving.d_mse_x100": "d, moving",
    "static.d_mse_x100": "d, static",
    "d_tof_mse_x100": "d_ToF, all",
    "moving.d_tof_mse_x100": "d_ToF, moving",
    "static.d_tof_mse_x100": "d_ToF, static",
}
"""What rows can state, by the key of metrics.json."""


@dataclass(frozen=True, kw_only=True)
class Stated:
    """A row of results.toml."""

    name: str
    """What ``gftorf reproduce`` calls it."""
    about: str
    """What it is."""
    page: str
    """Where it is published."""
    scene: str
    """What is simulated."""
    preset: str
    """What is fitted to it."""
    device: str
    """Where it was measured: ``cpu`` or ``cuda``."""
    seeds: tuple[int, ...]
    """Of the optimiser."""
    commit: str
    """The program's."""
    machine: str
    """What it was measured on."""
    values: Mapping[str, tuple[float, ...]]
    """Error of every seed, or the mean of all alone, by the key of metrics.json."""
    spread: float | None = None
    """Half of the width that is allowed, over the value [1]; None: from the seeds."""
    spread_from: str = "twice the largest deviation of a seed from the mean, at least 2 %"
    """How the spread was made."""
    images: int | None = None
    """Raw frames that were optimised; None: as the preset says."""
    frames: str = "all"
    """Raw frames that were scored."""
    simulate: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the recording."""

    @property
    def plan(self) -> Plan:
        """The row as a sweep."""
        simulate = {k: tuple(v) if isinstance(v, list) else v for k, v in self.simulate.items()}
        return Plan(
            scenes=(Scene(name=self.scene),),
            rows=(Row(preset=self.preset),),
            seeds=self.seeds,
            images=self.images,
            frames=self.frames,
            simulate=simulate,
        )

    def bounds(self, key: str) -> tuple[float, float, float]:
        """Least, stated and largest value of the mean over seeds."""
        values = self.values[key]
        mean = sum(values) / len(values)
        away = max(LEAST * mean, BEYOND * max(abs(value - mean) for value in values))
        if self.spread is not None:
            away = self.spread * mean
        return mean - away, mean, mean + away


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """One number of a row, measured again."""

    key: str
    """Its key of metrics.json."""
    stated: float
    """The stated mean over seeds."""
    least: float
    """Least value within the spread."""
    largest: float
    """Largest value within the spread."""
    by_seed: tuple[float, ...]
    """What was measured now."""

    @property
    def measured(self) -> float:
        """Mean over the seeds; not a number if one of them has no such error."""
        return sum(self.by_seed) / len(self.by_seed)

    @property
    def within(self) -> bool:
        """Whether it lies within the stated spread."""
        return self.least <= self.measured <= self.largest


def stated_results(path: str | Path | None = None) -> dict[str, Stated]:
    """All rows of a file, results.toml by default, by name.

    Raises:
        InputError: If it cannot be read.
    """
    results = {}
    for name, content in read_toml(Path(path or FILE)).items():
        values = {key: tuple(numbers) for key, numbers in content.pop("values").items()}
        seeds = tuple(content.pop("seeds"))
        results[name] = Stated(name=name, seeds=seeds, values=values, **content)
    return results


def stated_result(name: str, path: str | Path | None = None) -> Stated:
    """The row of a name.

    Raises:
        UsageError: If there is none.
    """
    known = stated_results(path)
    if name not in known:
        fix = did_you_mean(name, known, "`gftorf reproduce --list` shows all")
        why = f"there are {len(known)}, and none of this name"
        raise UsageError(f"no result {name}", where="gftorf reproduce", why=why, fix=fix)
    return known[name]


def reproduce(
    stated: Stated,
    *,
    out: str | Path | None = None,
    seeds: Sequence[int] | None = None,
    device: str | None = None,
    progress: Callable[..., None] | None = None,
) -> list[Reproduced]:
    """Simulate, fit and score what a row states.

    Args:
        stated: The row.
        out: A new or empty folder, for the sequence and the runs: results of an earlier version of
            the program must not count. None: gftorf-reproduce-NAME.
        seeds: Of the optimiser; None: those of the row.
        device: Where to compute; None: where it was measured.
        progress: Called with (jobs done, jobs in all).

    Returns:
        All numbers of the row.

    Raises:
        UsageError: If ``out`` is not empty.
        GftorfError: If a fit fails.
    """
    out = Path(out or f"gftorf-reproduce-{stated.name}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        why = "what an earlier version of the program wrote there would count"
        raise UsageError("the folder is not empty", where=out, why=why, fix="name a new --out")
    plan = dataclasses.replace(stated.plan, seeds=tuple(seeds or stated.seeds))
    devices = [device or stated.device]
    results = sweep(plan, out, devices=devices, workers=1, progress=progress)
    for result in results.values():
        if "error" in result:
            log = out / "runs" / result["id"] / "run.log"
            what, fix = f"{stated.name} cannot be done again", f"see {log}"
            raise GftorfError(what, where=result["id"], why=result["error"], fix=fix)
    metrics = [results[job.id]["metrics"] for job in plan.fits]
    reproduced = []
    for key in stated.values:
        least, mean, largest = stated.bounds(key)
        values = [look_up(scores, key) for scores in metrics]
        by_seed = tuple(math.nan if value is None else float(value) for value in values)
        about = {"stated": mean, "least": least, "largest": largest}
        reproduced.append(Reproduced(key=key, by_seed=by_seed, **about))
    return reproduced


def listed(rows: Mapping[str, Stated]) -> str:
    """A line per row: name, device, and what it is."""
    width = max(map(len, rows))
    return "\n".join(f"{row.name:<{width}}  {row.device:<4}  {row.about}" for row in rows.values())


def table(stated: Stated, reproduced: Sequence[Reproduced]) -> str:
    """Stated and measured numbers side by side, and the verdict."""
    lines = [
        f"{stated.name}: {stated.about}",
        f"stated in {stated.page}, at commit {stated.commit}, on {stated.machine}",
        f"spread: {stated.spread_from}",
        f"{UNIT:<22}{'stated':>10}{'spread':>22}{'measured':>12}",
    ]
    for one in reproduced:
        spread = f"{one.least:.4g} .. {one.largest:.4g}"
        numbers = f"{one.stated:>10.4g}{spread:>22}{one.measured:>12.4g}"
        lines.append(f"{TITLES[one.key]:<22}{numbers}  {'within' if one.within else 'outside'}")
    outside = [TITLES[one.key] for one in reproduced if not one.within]
    verdict = f"outside the stated spread: {'; '.join(outside)}" if outside else "all within"
    return "\n".join([*lines, verdict])


def as_json(stated: Stated, reproduced: Sequence[Reproduced]) -> str:
    """The same for other programs."""
    numbers = {
        one.key: dataclasses.asdict(one) | {"measured": one.measured, "within": one.within}
        for one in reproduced
    }
    within = all(one.within for one in reproduced)
    return json.dumps({"name": stated.name, "within": within, "numbers": numbers}, indent=2)
