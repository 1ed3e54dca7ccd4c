"""Runs of all kinds: ``Run.open`` finds each of them in its folder."""

from __future__ import annotations

from .runs.base import KINDS, Run
from .runs.closed_form import ClosedForm, Flow2D, Temporal
from .runs.volume import VolumeRun
from .runs.windowed import WindowedRun
from .settings import Method

__all__ = ["Run"]
KINDS |= {
    Method.GAUSSIANS: Run,
    Method.CTOF: ClosedForm,
    Method.TEMPORAL: Temporal,
    Method.FLOW2D: Flow2D,
    Method.TORF: VolumeRun,
    Method.FTORF: VolumeRun,
    Method.VOLUME: VolumeRun,
    "windows": WindowedRun,
}
