"""Reconstruction of a sequence in a folder that survives interruptions."""

from __future__ import annotations

import enum
import logging
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch

from ..data import resources
from ..data.constant import constant_part
from ..data.read import read, read_truth
from ..data.sequence import Sequence, Truth
from ..data.synchronised import has_tap_sums, unfilled_share
from ..errors import InputError, UsageError
from ..render.cuda import free_memory, on_device
from ..scene.changes import Wording, changed
from ..scene.initialise import Init
from ..scene.windows import Windows
from . import attempts, checkpoint, folder, presets, residuals, source
from .config import config_of
from .diagnostics import Diagnostics
from .loop import Progress, TrainingLoop
from .observations import former_hash, input_of, observe
from .record import Metrics, log_to
from .run import Run
from .settings import FITTED_ONLY, GAUSSIANS_ONLY, FlowSource, Input, Method, ReconSettings
from .state import State, begin, from_dict
from .suitable import check_sequence, faithfulness, log_faithfulness
from .volume import fit
from .volume.state import VolumeState

LOG = logging.getLogger("gftorf_warp")
Choice = TypeVar("Choice", bound=enum.StrEnum)
CHANGES = Wording(
    option="--set",
    example="init.reflectivity=0.5",
    where="config.json",
    fixed=("preset", "ablation", "method", "cycle"),
)  # these have options of their own, or follow from one


def reconstruct(
    sequence: Sequence | str | Path,
    out: str | Path,
    settings: ReconSettings | str = "best",
    *,
    images: int | None = None,
    input: Input | str = Input.AUTO,
    ablation: str | None = None,
    flow: FlowSource | str | None = None,
    changes: Iterable[str] = (),
    seed: int = 0,
    device: torch.device | str = "cpu",
    fresh: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Fit moving Gaussians to the raw quads of a sequence.

    Reads quads, calibration, poses, flow and colour; ground truth for diagnostics.jsonl only.
    A folder that holds the same run is resumed, on a CPU to the same bytes as an uninterrupted run;
    Ctrl-C and SIGTERM finish the step and store it.

    Args:
        sequence: What was recorded, or its folder.
        out: Folder of the run: config.json, metrics.jsonl, diagnostics.jsonl, run.log, ckpt/.
        settings: How, or the name of a preset.
        images: Raw frames to optimise, each as often as its turn comes; None: as the settings say.
        input: What is compared: auto, quads or phasor; used where ``settings`` is a name.
        ablation: Row of the ablation table to apply: nobias, dd, h1, h1h2 or h1h2dd; None: none.
        flow: Source of optical flow: auto, file, dis, deepflow or none; None: as the settings say.
        changes: Single settings like ``init.reflectivity=0.5``, applied last.
        seed: Of everything random.
        device: Where to compute, 'cpu' or a CUDA device.
        fresh: Whether to move what ``out`` holds aside, to ``out/old-<k>``, and start over.
        progress: Called as ``progress(images, images_in_all, loss=, psnr_db=, gaussians=)``.

    Returns:
        The finished run.

    Raises:
        InputError: If the sequence cannot be read or cannot start a reconstruction.
        UsageError: If ``out`` holds something else or other settings, or a name is unknown.
        ResourceError: If memory or disk cannot hold the optimisation.
        BusyError: If another process works on ``out``.
        DivergedError: If loss or gradient stay infinite; the last good checkpoint is kept.
        KeyboardInterrupt: After a signal, when everything is stored.

    >>> from gftorf_warp import reconstruct, simulate
    >>> recording = simulate("demo", "demo", frames=8, size=(24, 18))
    >>> run = reconstruct(recording, "run", images=8)  # 4,000 is the default here
    >>> run.render(time=0.0123).distance.shape
    torch.Size([18, 24])
    """
    begun = time.monotonic()
    if not isinstance(sequence, Sequence):
        sequence = read(sequence)
    changes = list(changes)
    settings = chosen_settings(sequence, settings, images, input, ablation, flow, changes)
    out = Path(out)
    config = config_of(sequence, settings, seed=seed, device=device)
    config |= {"flow": None if flow is None else str(flow), "changes": changes}
    config |= faithfulness(settings, changes)
    check_sequence(sequence, settings)
    _check_resources(sequence, settings, out, device)
    with folder.locked(out), on_device(device):
        goes_on = folder.prepare(out, config, fresh=fresh, former=former_hash(sequence))
        with log_to(out / "run.log"):
            _run(sequence, out, settings, config, seed, device, goes_on, begun, progress)
        return Run.open(out, device)


def chosen_settings(
    sequence: Sequence,
    settings: ReconSettings | str,
    images: int | None,
    input: Input | str,
    ablation: str | None,
    flow: FlowSource | str | None,
    changes: Iterable[str],
) -> ReconSettings:
    """The settings of a run from the arguments of :func:`reconstruct`.

    Raises:
        UsageError: If one of them is unknown or invalid.
    """
    if isinstance(settings, str):
        resolved = input_of(sequence, _choice(Input, input, "--input"))
        recorded = presets.Recorded.of(sequence, resolved)
        settings = presets.preset(settings, recorded)
    if ablation is not None:
        settings = presets.ablated(settings, ablation)
    if images is not None and settings.method.fits:
        settings = replace(settings, schedule=replace(settings.schedule, images=images))
    if flow is not None:
        settings = replace(settings, flow=_choice(FlowSource, flow, "--flow"))
        _check_flow(sequence, settings.flow)
    settings = changed(settings, changes, CHANGES)
    _check_windows(settings)
    _check_method(settings, input)
    return replace(settings, cycle=sequence.cycle)


def _check_method(settings: ReconSettings, input: Input | str) -> None:
    """Raise a UsageError if a setting contradicts the method."""
    if settings.method == Method.FLOW2D and settings.flow in (FlowSource.FILE, FlowSource.NONE):
        raise UsageError(
            f"flow {settings.flow} does not fit preset flow2d",
            where="--flow",
            why="it needs the flow of every raw frame, which no file contains",
            fix="use --flow dis or --flow deepflow",
        )
    names: tuple[str, ...] = () if settings.method == Method.GAUSSIANS else GAUSSIANS_ONLY
    if not settings.method.fits:
        names += FITTED_ONLY
    unfit = [n for n in names if getattr(settings, n) != getattr(ReconSettings, n)]
    if unfit:
        who = "Gaussians and volumes" if unfit[0] in FITTED_ONLY else "Gaussians"
        what, why = f"{unfit[0]} does not fit preset {settings.preset}", f"only {who} have it"
        raise UsageError(what, where="--set", why=why, fix=f"leave {unfit[0]} out")
    wanted = None
    if settings.method.is_volume:
        wanted = Input.PHASOR if settings.method == Method.TORF else Input.QUADS
    if wanted is not None and (settings.input != wanted or input not in (Input.AUTO, wanted)):
        raise UsageError(
            f"another input does not fit preset {settings.preset}",
            where="--input",
            why=f"it is the method that compares {wanted}",
            fix="leave --input out, or use --preset torf for phasors, ftorf for quads",
        )
    if settings.volume is not None and settings.volume.network.static != (wanted == Input.PHASOR):
        raise UsageError(
            f"volume.network.static does not fit preset {settings.preset}",
            where="--set",
            why="torf blends a network without time, the others have none",
            fix="leave volume.network.static out",
        )
    if wanted == Input.QUADS and settings.weights.colour > 0:
        raise UsageError(
            f"weights.colour does not fit preset {settings.preset}",
            where="--set",
            why="it is fitted to raw frames alone",
            fix="leave weights.colour out, or use --preset torf",
        )
    if wanted is not None and not settings.weights.quads > 0:
        raise UsageError(
            f"weights.quads = {settings.weights.quads} does not fit preset {settings.preset}",
            where="--set",
            why="without quads or phasors nothing determines a distance",
            fix="set it above 0",
        )


def _check_resources(
    sequence: Sequence, settings: ReconSettings, out: Path, device: torch.device | str
) -> None:
    """Raise a ResourceError if memory or disk cannot hold the optimisation."""
    if settings.method != Method.GAUSSIANS:
        return
    pixels = sequence.width * sequence.height
    if settings.width_max is not None:
        pixels = round(pixels * min(1.0, settings.width_max / sequence.width) ** 2)
    random = settings.init.kind == Init.RANDOM
    first = settings.init.count if random else pixels / settings.init.static_spacing**2
    count = min(round(first), settings.densify.gaussians_max)
    need = resources.to_reconstruct(sequence.frames, pixels, count)
    fix = "use smaller images (--set width_max=160), or a shorter recording"
    resources.require(need, out, fix)
    if (free := free_memory(device)) is not None:
        need = resources.to_reconstruct_on_gpu(sequence.frames, pixels, count)
        resources.require(need, out, f"{fix}, or --device cpu", free=free)


def _check_flow(sequence: Sequence, flow: FlowSource) -> None:
    """Raise a UsageError if the sequence's own optical flow is chosen and it has none."""
    if flow == FlowSource.FILE and not (sequence.flow.forward or sequence.flow.backward):
        raise UsageError(
            "no optical flow to read",
            where="--flow file",
            why=f"{sequence.path or 'the sequence'} has no forward_flow and no backward_flow",
            fix="use --flow dis, which computes it, or --flow none",
        )


def _check_windows(settings: ReconSettings) -> None:
    """Raise a UsageError if windows lack their initialisation, or for a loss that contradicts
    them.
    """
    kind, start = settings.motion.kind, settings.init.kind
    if (kind == Windows.kind) != (start == Init.QUARTETS):
        raise UsageError(
            f"init.kind {start} does not fit motion.kind {kind}",
            where="--set",
            why="windows need moving Gaussians of every quartet, which other motions cannot follow",
            fix=f"set both: init.kind={Init.QUARTETS} and motion.kind={Windows.kind}, or "
            f"init.kind={Init.PHASE} and motion.kind=nodes",
        )
    for name in ("flow", "motion_size") if kind == Windows.kind else ():
        if getattr(settings.weights, name) > 0:
            raise UsageError(
                f"weights.{name} does not fit motion.kind windows",
                where="--set",
                why="no Gaussian moves from one quartet to the next"
                if name == "flow"
                else "Gaussians outside their window count as displaced by a thousand kilometres",
                fix=f"use --set weights.{name}=0",
            )


def _choice(kind: type[Choice], name: str, option: str) -> Choice:
    """The member of an enumeration that a user named, or a UsageError."""
    known = [str(member) for member in kind]
    if name not in known:
        what, why = option.lstrip("-"), f"there are {', '.join(known)}"
        fix = f"use {option} {known[0]}"
        raise UsageError(f"unknown {what} {name}", where=option, why=why, fix=fix)
    return kind(name)


def _run(sequence, out, settings, config, seed, device, goes_on, begun, progress) -> None:
    log_faithfulness(settings, config)
    config |= {
        "quad_scale": 1.0,
        "quad_scale_source": "nothing is scaled",
        "flow_source": "none",
        "size_optimised": [sequence.width, sequence.height],
        "input": str(input_of(sequence, settings.input)),
    }
    if not settings.method.fits:
        config |= {"images_optimised": 0, "seconds_reconstruct": 0.0}
        if settings.method == Method.FLOW2D:
            config |= _synchronise(sequence, settings)
            config["seconds_reconstruct"] = time.monotonic() - begun
        folder.write_config(out, config)
        LOG.info("%s is finished: a closed form needs no image", out)
        return
    stored = checkpoint.last(out, device) if goes_on else None
    if stored is not None and attempts.are_over(stored, settings, out):
        if sequence.path is not None:  # it may have moved
            source.store_folder(out, sequence.path)
        known = folder.read_config(out)
        if "explained" not in known:  # the process was killed after the last checkpoint
            attempts.conclude(out, known, stored, _judged(sequence, out, device))
        LOG.info("%s is finished: %d images", out, stored["images"])
        return
    observations = observe(sequence, settings, device)
    _warn(sequence, observations.sequence)
    earlier = 0.0 if stored is None else stored["seconds"]

    def clock() -> float:
        return earlier + time.monotonic() - begun

    config |= {
        "quad_scale": observations.quad_scale,
        "quad_scale_source": observations.quad_scale_source,
        "flow_source": observations.flow_source,
        "input": str(Input.PHASOR if observations.phasors else Input.QUADS),
        "colour_scale": observations.colour_scale,
        "size_optimised": [observations.sequence.width, observations.sequence.height],
    }
    folder.write_config(out, config)
    given = observations, settings, out, stored
    more = {"seed": seed, "clock": clock, "progress": progress}
    state: VolumeState | State
    if settings.method.is_volume:
        state = fit.fit(*given, **more)
        judged = _judged(sequence, out, device)
    else:
        state, judged = _fit_gaussians(sequence, *given, **more)
    LOG.info("%s is finished: %d images, %.1f s", out, state.images, state.seconds)
    attempts.conclude(out, config, vars(state), judged)


def _judged(
    sequence: Sequence, out: Path, device: torch.device | str
) -> residuals.Residuals | None:
    """Residuals of what is stored in the folder of a run."""
    return residuals.residuals(Run.open(out, device), sequence)


def _fit_gaussians(
    sequence, observations, settings, out, stored, *, seed, clock, progress
) -> tuple[State, residuals.Residuals | None]:
    """Train Gaussians until the images of the settings are used up, in as many attempts as it
    takes; the state that stays, and its residuals.
    """
    device, total = observations.quads.device, settings.schedule.images

    def begun(number: int) -> State:
        chosen, of_attempt = attempts.settings_of(settings, number), attempts.seed_of(seed, number)
        return begin(observations, chosen, seed=of_attempt, device=device)

    if stored is None:
        state = begun(1)
    else:
        with checkpoint.rebuilding(out):
            state = from_dict(stored, device)
    metrics = Metrics(out / "metrics.jsonl")
    diagnostics = Diagnostics(observations, _truth(sequence), out / "diagnostics.jsonl")
    verb = "starts at" if stored is None else "goes on at"
    layer = state.optimiser.layer
    moving = 0 if layer is None else int((layer > 0).sum())
    text = "%s %s image %d of %d, %d Gaussians, %d of them moving"
    LOG.info(text, out, verb, state.images, total, len(state.optimiser.field), moving)
    if total <= (warm_up := settings.schedule.warm_up):
        text = "nothing will move: the warm-up takes %d images, the run %d"
        LOG.warning(text, warm_up, total)

    def train(state: State) -> State:
        for rows in (metrics, diagnostics):
            rows.rewind(state.images or -1)  # the row of the start is written once more
        chosen = attempts.settings_of(settings, state.attempt)
        if device.type == "cpu":  # a thread per image: no result depends on their number
            chosen = replace(chosen, render=replace(chosen.render, threads=1))
        records = metrics, diagnostics, clock, progress
        first = attempts.seed_of(seed, state.attempt)
        return TrainingLoop(observations, chosen, first, out, *records).run(state)

    def judge() -> residuals.Residuals | None:
        return _judged(sequence, out, device)

    return attempts.run(state, settings, out, train=train, begin=begun, judge=judge)


def _synchronise(sequence: Sequence, settings: ReconSettings) -> dict[str, object]:
    """What config.json says of method flow2d."""
    share = unfilled_share(sequence, settings.flow.matcher)
    text = "optical flow brought nothing to %.2f %% of the pixels: hidden, or it is wrong there"
    LOG.info(text, 100.0 * share)
    kind = "tap sums" if has_tap_sums(sequence) else "computed"
    return {"flow_source": kind, "unfilled_share": share}


def _warn(sequence: Sequence, compared: Sequence) -> None:
    """Log what cannot be fitted: a wrong constant part of what is compared (method, mistake 17), a
    rolling shutter.
    """
    stated = sequence.calibration
    if sequence.complete_quartets and not sequence.from_phasors:
        part = constant_part(compared)
        if not part.is_explained:
            text = (
                "the quads have a constant part of %.2f amplitudes more than the calibration says"
            )
            LOG.warning(f"{text}: see `gftorf check`", part.left)
    delay = float(stated.settings.get("row_time_s", 0.0) or 0.0)
    if delay > 0:
        text = "a rolling shutter: the last row is %.3g ms later than the first, which is ignored"
        LOG.warning(text, 1e3 * delay * (sequence.height - 1))


def _truth(sequence: Sequence) -> Truth | None:
    """Ground truth for the diagnostics; None if there is none that can be read."""
    try:
        return read_truth(sequence)
    except InputError as error:
        LOG.warning("diagnostics go without truth: %s: %s", error.where, error.what)
        return None
