"""Whether a method can be applied to a recording, and what of it is as published."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from ..data.sequence import Sequence
from ..data.synchronised import check_flow
from ..data.temporal import camera_rests
from ..errors import InputError
from .closed_form import check_rests, checked
from .settings import Method, ReconSettings
from .volume.models import VOLUMES
from .volume.settings import PUBLISHED_STEPS

LOG = logging.getLogger("gftorf_warp")
FAITHFUL: dict[Method, tuple[str, ...]] = {
    Method.FLOW2D: (
        "flow between raw frames of one shift, softmax splatting to one time, closed form",
    )
} | {method: kind.faithful for method, kind in VOLUMES.items()}
"""What is as published, in sentences, of methods that others published."""
ASSUMED: dict[Method, tuple[str, ...]] = {
    Method.FLOW2D: (
        "optical flow is by OpenCV; the publication uses RAFT, a trained network",
        "hidden pixels take the median flow of their image; the publication keeps them as measured",
        "flow of a raw frame is the median over the pairs of all shifts around it, or that of tap "
        "sums",
        "of several frequencies, a pixel keeps its raw frames where their phases agree better",
    )
} | {method: kind.assumed for method, kind in VOLUMES.items()}
"""What was not published, or is done in another way."""
RENDERER = (
    "centres are drawn in the frusta of the cameras, not in a box around them",
    "opacities are not reset in the last tenth before densification ends",
)
EXACT = "Gaussians are rendered to the bound of their alpha, with the exact gradient of the clamp"
GAUSSIANS: dict[str, tuple[str, ...]] = {
    "paper": (*RENDERER, EXACT, "what the paper does not state is as in its released code"),
    "released": (*RENDERER, "at most 200,000 Gaussians"),
    "dgs": (*RENDERER, EXACT, "values are those of paper, with the losses of deformable Gaussians"),
    "dgs_depth": (
        *RENDERER,
        EXACT,
        "values are those of paper, and the weight of the depth loss is not published",
    ),
    "fast": (
        "released in a quarter of the steps, of whole quartets: rates, warm-up and pruning differ",
    ),
}
"""The same by the name of a preset of Gaussians that others published (design/published-presets.md)
or that is after one of them; our own have none."""


def check_sequence(sequence: Sequence, settings: ReconSettings) -> None:
    """Refuse a recording that a method cannot be applied to.

    Raises:
        InputError: If it has no complete quartet, or lacks raw frames, optical flow, colour or a
            camera at rest where the method needs them.
    """
    method = settings.method
    if method in (Method.CTOF, Method.TEMPORAL):
        checked(sequence)
    if method == Method.TEMPORAL:
        check_rests(sequence)
    elif method == Method.FLOW2D:
        check_flow(sequence)
    elif method.is_volume:
        _check_volume(sequence, method)
    elif method == Method.GAUSSIANS:
        _check_colour(sequence, settings)


def _check_volume(sequence: Sequence, method: Method) -> None:
    where, fix = sequence.path or "sequence", "use --preset torf, or best"
    if not sequence.complete_quartets:
        why = "expected all raw frames of a cycle in a row, at least once"
        fix = "check the sequence with `gftorf check`, or record longer"
        raise InputError("no complete quartet", where=where, why=why, fix=fix)
    if method == Method.TORF:
        return
    if sequence.from_phasors:
        why = f"the camera delivered phasors, and {method} compares raw frames at their own times"
        raise InputError("no raw frames", where=where, why=why, fix=fix)
    if not camera_rests(sequence):
        why = "the samples of all raw frames of a cycle are on the rays of one pose, as published"
        raise InputError("the camera moves", where=where, why=why, fix=fix)


def _check_colour(sequence: Sequence, settings: ReconSettings) -> None:
    weights = settings.weights
    if weights.colour > 0 and weights.quads == 0 and not sequence.colour.images:
        raise InputError(
            "no colour",
            where=sequence.path or "sequence",
            why=f"preset {settings.preset} compares colour alone, and there is no colour image",
            fix="use --preset best, or record with a calibrated colour camera",
        )


def faithfulness(settings: ReconSettings, changes: Iterable[str]) -> dict[str, list[str]]:
    """What is as published and what is not, for the log and config.json; nothing of methods that
    are not rebuilt from a publication.

    Args:
        settings: How is fitted.
        changes: Settings that were changed by name, which makes them differ from published ones.
    """
    method, steps = settings.method, settings.schedule.images
    if settings.preset in GAUSSIANS:
        return {"assumed": [*GAUSSIANS[settings.preset], *_changed(changes)]}
    if method not in ASSUMED:
        return {}
    shortened = method.is_volume and FAITHFUL[method] and steps != PUBLISHED_STEPS
    changed = list(changes) + ([f"{steps} steps"] if shortened else [])
    assumed = [*ASSUMED[method], *_changed(changed)]
    return {"faithful": list(FAITHFUL[method]), "assumed": assumed}


def _changed(changes: Iterable[str]) -> list[str]:
    changes = list(changes)
    return [f"changed: {', '.join(changes)}"] if changes else []


def log_faithfulness(settings: ReconSettings, statements: dict[str, list[str]]) -> None:
    """Log what :func:`faithfulness` states of a method that is not our renderer."""
    if settings.method == Method.GAUSSIANS:
        return
    for sentence in statements.get("faithful", ()):
        LOG.info("%s, as published: %s", settings.preset, sentence)
    for sentence in statements.get("assumed", ()):
        LOG.info("%s, assumed or different: %s", settings.preset, sentence)


def about_preset(sequence: Sequence, settings: ReconSettings) -> str:
    """What `gftorf check --preset` prints of a preset that can be applied to a recording.

    Raises:
        InputError: If it cannot.
    """
    check_sequence(sequence, settings)
    statements = faithfulness(settings, ())
    lines = [f"preset {settings.preset} can be applied to it"]
    lines += [f"  as published    {sentence}" for sentence in statements.get("faithful", ())]
    lines += [f"  assumed         {sentence}" for sentence in statements.get("assumed", ())]
    return "\n".join(lines)
