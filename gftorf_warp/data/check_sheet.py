"""Contact sheet of a check: the middle quartet, and the distances of each hypothesis on order."""

from __future__ import annotations

import numpy as np

from ..constants import SPEED_OF_LIGHT
from .contact_sheet import COLUMNS, Panel, middle_panels, painted, scaled, viridis
from .hypotheses import Hypothesis, hypotheses
from .report import Report
from .sequence import Sequence

SHOWN = 8  # hypotheses: as many as share their pairs of shifts, which look alike at first sight
UNDECODED = ("no light", "common range")  # findings with which nothing can be decoded


def check_sheet(sequence: Sequence, report: Report) -> bytes:
    """PNG of a sequence that was checked: what was measured, and what it would mean.

    Hypotheses are those of the order of shifts, the stated one first, then the others by rank.
    """
    n, rows = middle_panels(sequence, None)
    names = list(dict.fromkeys(finding.name for finding in report.findings))
    shown = f"the quartet of raw frame {n}"
    if not set(names) & set(UNDECODED):
        panels = _hypotheses(sequence)
        rows += [panels[i : i + COLUMNS] for i in range(0, len(panels), COLUMNS)]
        shown += ", then distances for orders of the shifts, the stated one first"
    name = "sequence" if report.path is None else report.path.name
    return painted(sequence, f"{name}: {', '.join(names) or 'no warnings'}", shown, rows)


def _hypotheses(sequence: Sequence) -> list[Panel]:
    """Distances on one scale; a better order than the stated one is marked."""
    shown, end = hypotheses(sequence)[:SHOWN], SPEED_OF_LIGHT / (2.0 * sequence.frequencies[0])
    return [
        scaled(_title(k, one, shown[0]), np.asarray(one.distance), (0.0, end), viridis)
        for k, one in enumerate(shown)
    ]


def _title(rank: int, one: Hypothesis, stated: Hypothesis) -> str:
    """Order, measures and verdict, as short as a panel is wide."""
    start = "stated" if rank == 0 else f"{rank}"
    if rank > 0 and one.beats(stated):
        start += ", better"
    order = one.degrees.replace(", ", " ")
    return f"{start}: {order}; {one.unexplained:.0%} left, fall-off {one.falloff:.2f}"
