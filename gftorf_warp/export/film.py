"""Distance, and colour if there is any, as a video or an animation."""

from __future__ import annotations

from pathlib import Path

from ..evaluate.views import render_to_video
from .moments import Moments, Progress


def write(moments: Moments, path: Path, progress: Progress) -> None:
    """Write a video, whose kind the suffix of the path is; see evaluate/video.py."""
    what = ("distance", "colour") if moments.run.has_colour else ("distance",)
    render_to_video(moments.run, path, what, moments.times, progress=progress)
