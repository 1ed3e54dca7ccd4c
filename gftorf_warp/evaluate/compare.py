"""``gftorf compare``: errors of a run and of the closed form, as numbers and as an offline page."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from .. import __version__
from ..data import resources, steps
from ..data.decode import unambiguous_range
from ..data.files import atomic_write, write_json
from ..data.read import read, read_truth
from ..data.sequence import Sequence, Truth
from ..data.texts import read_rows
from ..data.truth import known_distance, moving_and_static, static_throughout
from ..data.unwrap import CONFIDENT
from ..errors import InputError, UsageError
from ..recon import checkpoint, residuals
from ..recon.raw_frames import RawFrames
from . import classes, gallery, views
from . import metrics as measure
from .caveats import caveats
from .panels import Comparison, Judgement
from .provenance import fact, method_of, version_of
from .renders import stated_images

if TYPE_CHECKING:
    from ..recon.run import Run

GROUPS = ("moving", "static", "static_throughout")
"""Pixels that are scored apart from all others."""
AGAINST = ("geometry", "static-phasor")
"""Choices of the true distance; the first is the default."""
FACTS = (
    "seconds_reconstruct", "images_optimised", "device", "seed", "preset",
    "ablation", "input", "flow_source", "init", "motion",
    "unfilled_share",
)  # fmt: skip


def compare(
    run: Run | str | Path,
    *,
    truth: str | Path | None = None,
    frames: str = "all",
    against: str = "geometry",
    report: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Score a run and write ``RUN/metrics.json`` and ``RUN/report.html``.

    Every scored raw frame is rendered at its time and pose, at the sequence's own resolution, over
    a black background. Errors are mean squared errors of the distance along the ray [m^2], times
    100.

    Args:
        run: A finished reconstruction, or its folder.
        truth: A sequence with the ground truth; None: the sequence of the run.
        frames: The scored raw frames: ``all``, or ``ftorf13`` as in the published tables.
        against: The true distance: ``geometry``, or ``static-phasor``, the closed form of a static,
            noise-free scene. Moving pixels are those of geometry in both cases.
        report: Whether to write the page as well.
        progress: Called with (steps done, steps in all): raw frames whose residuals are computed,
            then those that are scored.

    Returns:
        The content of metrics.json; None where there is no truth or no such pixel.

    Raises:
        InputError: If the run or a sequence cannot be read, the truth does not fit, no quartet
            is complete, or the report is of a later state of the run.
        UsageError: If ``frames`` is unknown or leaves nothing, or ``against`` is unknown.
        DivergedError: If a rendering is not finite.
        ResourceError: If memory or disk cannot hold the images or the page.

    >>> from gftorf_warp import compare, reconstruct, simulate
    >>> recording = simulate("demo", "demo", frames=8, size=(24, 18))
    >>> metrics = compare(reconstruct(recording, "run", images=8))
    >>> metrics["frames"], metrics["moving"]["closed_form_mse_x100"] > 0
    (8, True)
    """
    if isinstance(run, (str, Path)):
        from ..recon.run import Run

        run = Run.open(run)
    _refuse_earlier_state(run)
    result, comparison = score(
        run, truth=truth, frames=frames, against=against, novel=report, progress=progress
    )
    write_json(run.path / "metrics.json", result)
    if report:
        write_report(run, result, comparison)
    return result


def score(
    run: Run,
    *,
    truth: str | Path | None = None,
    frames: str = "all",
    against: str = "geometry",
    novel: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, Any], Comparison]:
    """:func:`compare` without files: the content of metrics.json, and its arrays; with novel views
    if they are wanted.
    """
    if against not in AGAINST:
        why, fix = f"expected one of {', '.join(AGAINST)}", "use --against geometry"
        raise UsageError(f"unknown truth {against!r}", where="--against", why=why, fix=fix)
    sequence = run.sequence()
    known = fitting_truth(sequence, truth)
    scored = measure.scored_frames(sequence, frames)
    need = resources.to_compare(len(scored), sequence.height * sequence.width)
    resources.require(need, run.path, "score fewer raw frames, --frames ftorf13")
    rendered = RawFrames(run, sequence, views.RENDERED, kept=scored)
    judging, scoring = _in_turn(progress, len(scored))
    explained = residuals.explained(run, rendered, judging)  # first: the fallback needs it
    gathered = views.gather(run, sequence, scored, rendered=rendered, progress=scoring)
    comparison = replace(
        comparison_of(sequence, gathered, known, against=against),
        colour=gallery.colour_views(run, sequence, scored),
        residuals=explained,
        novel=gallery.novel_views(run, sequence) if novel else None,
    )
    residuals.warn(comparison.residuals)
    result = summary(run, comparison, protocol=frames, against=against)
    result["caveats"] = caveats(run.config, sequence, known)
    return result, comparison


def _in_turn(
    progress: Callable[[int, int], None] | None, count: int
) -> tuple[Callable[[int, int], None], Callable[[int, int], None]]:
    """Progress of the residuals, and after them of the ``count`` raw frames that are scored."""
    judged = 0

    def judging(done: int, total: int) -> None:
        nonlocal judged
        judged = total
        if progress is not None:
            progress(done, total + count)

    def scoring(done: int, total: int) -> None:
        if progress is not None:
            progress(judged + done, judged + total)

    return judging, scoring


def _refuse_earlier_state(run: Run) -> None:
    """Check that no report of a later state of the run would be replaced.

    Raises:
        InputError: If one would be.
    """
    path = run.path / "metrics.json"
    reported = stated_images(path)
    reached = run.config.get("images_optimised") or 0
    if reported > reached:
        why = f"it is of image {reported}, the newest readable checkpoint of image {reached}"
        fix = "restore the checkpoint, or move metrics.json and report.html elsewhere"
        raise InputError("the report is of a later state", where=path, why=why, fix=fix)


def fitting_truth(sequence: Sequence, path: str | Path | None = None) -> Truth | None:
    """Ground truth of a sequence, or of one at ``path`` of the same size; None if unknown.

    Raises:
        InputError: If ``path`` holds no ground truth, or frames or size differ.
    """
    truth = read_truth(sequence if path is None else read(path))
    if truth is None or not truth.known.any():
        if path is None:
            return None
        why = "--truth was given, but this sequence stores no true distance"
        fix = "leave --truth out, or name a sequence with synthetic_depth/"
        raise InputError("no ground truth", where=path, why=why, fix=fix)
    if truth.distance.shape != sequence.quads.shape:
        shapes = sequence.quads.shape, truth.distance.shape
        expected, got = ("x".join(map(str, shape)) for shape in shapes)
        where, why = (
            path or sequence.path,
            f"expected frames x rows x columns {expected}, found {got}",
        )
        fix = "name the sequence that the run was reconstructed from, at the same size"
        raise InputError(
            "the truth does not fit the run", where=where or "sequence", why=why, fix=fix
        )
    return truth


def comparison_of(
    sequence: Sequence, gathered: views.Views, truth: Truth | None, *, against: str = AGAINST[0]
) -> Comparison:
    """Views with their errors if there is a truth.

    Raises:
        InputError: If ``against`` is static-phasor and the truth has no such distance.
    """
    if truth is None:
        return Comparison(sequence=sequence, views=gathered, judgement=None)
    distance = known_distance(truth)
    moving, static = moving_and_static(
        distance, gathered.frames, from_phasors=sequence.from_phasors, cycle=sequence.cycle
    )
    throughout = static & static_throughout(distance)
    if against != AGAINST[0]:
        distance = _static_phasor(sequence, truth)
    scored, images = distance[gathered.frames], gathered.distances.items()
    errors = {name: measure.squared_error(image, scored) for name, image in images}
    groups = {"moving": moving, "static": static, "throughout": throughout}
    judgement = Judgement(truth=scored, errors=errors, **groups)
    return Comparison(sequence=sequence, views=gathered, judgement=judgement)


def _static_phasor(sequence: Sequence, truth: Truth) -> Float[np.ndarray, "F H W"]:
    where, given = sequence.path or "sequence", "--against static-phasor was given"
    if truth.phasor_distance is None:
        why = f"{given}, but the truth is geometry only"
        fix = "leave --against out, or name a sequence that was simulated with it by --truth"
        raise InputError("no static-phasor distance", where=where, why=why, fix=fix)
    if len(sequence.frequencies) > 1:
        what, fix = "a static-phasor distance of one frequency", "leave --against out"
        why = f"{given}, and here are {len(sequence.frequencies)}, unwrapped together"
        raise InputError(what, where=where, why=why, fix=fix)
    return np.where(truth.known[:, None, None], truth.phasor_distance, np.nan)


def summary(
    run: Run, comparison: Comparison, *, protocol: str, against: str = AGAINST[0]
) -> dict[str, Any]:
    """The content of metrics.json: numbers, texts and None."""
    views, confidence, colour = comparison.views, comparison.views.confidence, comparison.colour
    peak = float(np.abs(comparison.sequence.quads[comparison.sequence.measured]).max())
    return {
        "frames": len(views.frames),
        "protocol": protocol,
        "against": against,
        **_errors(comparison.judgement),
        "unambiguous_range_m": unambiguous_range(comparison.sequence),
        "ambiguous_share": None if confidence is None else float((confidence < CONFIDENT).mean()),
        "source": views.source_shares,
        "explained": comparison.residuals and comparison.residuals.as_json(),
        "quad_psnr_db": measure.psnr_db(views.quad_rendered, views.quad_measured, peak),
        "colour_psnr_db": colour
        and measure.psnr_db(colour.rendered, colour.measured, peak=float(colour.measured.max())),
        "gaussians": run.gaussians,
        "diagnostics": measure.along_run(read_rows(run.path / "diagnostics.jsonl")),
        **{name: fact(run.config, name) for name in FACTS},
        "method": method_of(run.config),
        "checkpoint_sha256": checkpoint.digest(run.path, run.config.get("images_optimised") or 0),
        "version": __version__,
    }


def _errors(judgement: Judgement | None) -> dict[str, object]:
    """The errors of metrics.json on all, moving and static pixels; None without ground truth."""
    if judgement is None:
        unknown: dict[str, None] = {f"{name}_mse_x100": None for name in measure.DISTANCES}
        group = {**unknown, "share": None}
        return {**unknown, **dict.fromkeys(GROUPS, group), "classes": None}
    moving, static, errors = judgement.moving, judgement.static, judgement.errors
    return {
        **measure.distance_errors(errors, np.ones_like(moving), measure.mean_over_frames),
        **{
            name: {
                **measure.distance_errors(errors, mask),
                "share": measure.share(mask, (moving | static) & ~mask),
            }
            for name, mask in zip(GROUPS, (moving, static, judgement.throughout), strict=True)
        },
        "classes": {
            "step_m": steps.STEP_M,
            "edge_px": steps.EDGE_PX,
            **classes.class_errors(errors, judgement.truth, moving, static),
        },
    }


def write_report(run: Run, result: dict[str, Any], comparison: Comparison) -> Path:
    """Write ``RUN/report.html``."""
    from . import report

    path = run.path / "report.html"
    page = report.report(
        title=sequence_title(comparison.sequence.path) or run.path.name,
        metrics=result,
        config=run.config,
        log=read_rows(run.path / "metrics.jsonl"),
        diagnostics=read_rows(run.path / "diagnostics.jsonl"),
        comparison=comparison,
        installed=installed_versions(),
        data_card=truth_statement(comparison.sequence.path),
        simulated=simulate_command(comparison.sequence.path),
    )
    atomic_write(path, page.encode("utf-8"))
    return path


def installed_versions() -> str:
    """Versions of this package, its main dependencies and the platform."""
    packages = ("torch", "warp-lang", "numpy")
    versions = ", ".join(f"{name} {version_of(name)}" for name in packages)
    system = f"Python {platform.python_version()}, {platform.system()}"
    return f"gftorf-warp {__version__}, {versions}, {system}"


def sequence_title(path: Path | None) -> str | None:
    """Title of a sequence: the heading of its README.md as text, else the name of its folder."""
    first = _data_card(path).partition("\n")[0].replace("`", "")
    if first.startswith("# "):
        return first.removeprefix("# ").strip()
    return None if path is None else path.name


def truth_statement(path: Path | None) -> str | None:
    """The paragraphs of a sequence's README.md on ground truth; None if there are none."""
    paragraphs = _data_card(path).split("\n\n")
    about = [text for text in paragraphs if text.lower().startswith("ground truth")]
    return " ".join(" ".join(about).split()) or None


def simulate_command(path: Path | None) -> str | None:
    """The command in a sequence's README.md that made it; None if there is none."""
    lines = map(str.strip, _data_card(path).splitlines())
    return next((line for line in lines if line.startswith("gftorf simulate ")), None)


def _data_card(path: Path | None) -> str:
    card = None if path is None else path / "README.md"
    if card is None or not card.is_file():
        return ""
    return card.read_text(encoding="utf-8", errors="replace")
