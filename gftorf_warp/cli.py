"""The command ``gftorf``: options to arguments, exceptions to messages and exit codes.

Heavy modules are imported when a command needs them. This is the only file that chooses a device.
"""

from __future__ import annotations

import argparse
import atexit
import functools
import gc
import logging
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__
from .errors import InputError, ResourceError, UsageError
from .options import parse
from .process import (
    available_cpus,
    exit_at_once,
    on_cpus,
    open_cuda,
    sigterm_raises,
    without_garbage_collection,
)

if TYPE_CHECKING:
    from .data.report import Report
    from .data.sequence import Sequence
    from .recon.run import Run
    from .sim.scene import Scene


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words after ``gftorf``; None: those of the process, which then ends.

    Returns:
        Exit code: 0 ok, 1 a bug or a failed self-test, 2 usage, 3 bad input, 4 diverged, 5
        resources, 6 busy, 130 interrupted by Ctrl-C, 143 by SIGTERM.
    """
    from .terminal import logging_to_stderr, print_error

    if arguments is None:
        codes: list[int] = []
        atexit.register(exit_at_once, codes)  # before all others, so that it runs after them
        codes.append(main(sys.argv[1:]))
        return codes[0]
    debug = "--debug" in arguments
    try:
        options = parse(list(arguments))
        open_cuda(getattr(options, "device", "cpu"))
        with (
            sigterm_raises(),
            logging_to_stderr(_level(options)),
            on_cpus(getattr(options, "threads", None)),
        ):
            return COMMANDS[options.command](options)
    except SystemExit as stop:  # --help and --version
        return int(stop.code or 0)
    except BrokenPipeError:  # the reader of stdout has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (Exception, KeyboardInterrupt) as error:
        return print_error(error, debug=debug)
    finally:
        gc.unfreeze()


def choose_device(name: str) -> tuple[str, str]:
    """Device for torch and Warp, and its name or the reason for the CPU.

    Args:
        name: "auto", "cpu", "cuda" or "cuda:N".

    Raises:
        ResourceError: If CUDA was requested and is not available.
    """
    import torch
    import warp as wp

    if name == "cpu":
        return "cpu", ""
    if not torch.cuda.is_available():
        if wp.get_cuda_driver_version() is None:
            reason = "no CUDA driver found"
        elif torch.version.cuda is None:
            reason = "this torch is a CPU build"
        else:
            reason = "no CUDA driver or GPU found"
    elif not wp.is_cuda_available():
        reason = "Warp cannot use the CUDA driver"
    else:
        index = int(name.partition(":")[2] or 0)
        if index < torch.cuda.device_count():
            return f"cuda:{index}", torch.cuda.get_device_name(index)
        reason = f"there are {torch.cuda.device_count()} GPUs, counted from 0"
    if name == "auto":
        return "cpu", reason
    raise ResourceError(
        f"no device {name}", where="--device", why=reason, fix="leave --device out, or --device cpu"
    )


def start(options: argparse.Namespace, *, compile_first: bool = True) -> str:
    """Import torch and Warp, log the device, compile kernels if none are cached; the device."""
    with without_garbage_collection():
        import torch

        from . import terminal

        terminal.start_warp()
    device, reason = choose_device(getattr(options, "device", "cpu"))
    threads = min(torch.get_num_threads(), available_cpus())
    cache = terminal.home_as_tilde(terminal.kernel_cache())
    details = "; ".join(filter(None, [f"{threads} threads", reason]))
    text = "gftorf_warp %s - device %s (%s) - kernels cached in %s"
    terminal.LOG.info(text, __version__, device, details, cache)
    if compile_first:
        compile_first_time(device)
    return device


def compile_first_time(device: str) -> None:
    """Compile kernels if none are cached."""
    from . import doctor, terminal

    if not terminal.kernels_are_cached():
        message = "  compiling kernels (first run only) ..."
        terminal.LOG.info(message)
        terminal.LOG.info("%s %.1f s", message, doctor.compile_kernels(device))


def _demo(options: argparse.Namespace) -> int:
    from .demo import demo

    device = start(options)
    given = _named(options, "seed", "size", "frames", "images", "fresh")
    print("\n".join(demo(options.out, device=device, progress=_progress(options), **given)))
    return 0


def _simulate(options: argparse.Namespace) -> int:
    from .sim.scenes import SCENES

    if options.list:
        print(f"{'scene':<21}{'raw frames':>10}{'closed form':>13}  motion: description")
        for scene in _listed(options, SCENES):
            error = "-" if scene.closed_form is None else f"{scene.closed_form:.4g}"
            about = f"{scene.motion}: {scene.description}"
            print(f"{scene.name:<21}{scene.frames:>10}{error:>13}  {about}")
        error = "its mean squared error on ideal quads [m^2 x 100], see design/look-alikes.md"
        print(f"closed form: {error}")
        if options.scene is None:
            print(
                "random: drawn from --seed; `gftorf simulate random --seed N --list` describes it"
            )
        return 0
    if options.scene is None or options.out is None:
        missing = "SCENE" if options.scene is None else "--out SEQ"
        example = f"`gftorf simulate {next(iter(SCENES))} --out sequence`"
        fix = f"for example {example}; `gftorf simulate --list`"
        why = "both are needed"
        raise UsageError(f"{missing} is missing", where="gftorf simulate", why=why, fix=fix)
    from dataclasses import fields

    from .sim.closed_form_errors import ladder_table
    from .sim.ladder import NAMES
    from .sim.settings import SimSettings
    from .sim.simulate import simulate, simulate_ladder

    device = start(options)
    values = _named(options, *(field.name for field in fields(SimSettings)))
    where = {"device": device, "fresh": options.fresh}
    if not options.ladder:
        given = options.scene, options.out, SimSettings(**values)
        print(simulate(*given, **where, progress=_progress(options)("simulate")))
        return 0
    if options.level is not None:
        why, fix = "--ladder records all of them", "leave one of the two out"
        raise UsageError("one level or all", where="--level", why=why, fix=fix)
    values["level"] = NAMES[0]  # which decides about the engine, as all levels do alike
    given = options.scene, options.out, SimSettings(**values)
    rows = simulate_ladder(*given, **where, progress=_each_level(options))
    print("\n".join(ladder_table(rows)))
    return 0


def _listed(options: argparse.Namespace, scenes: Mapping[str, Scene]) -> list[Scene]:
    """The scenes of ``--list``: all, or the named one with its overrides."""
    if options.scene is None:
        return list(scenes.values())
    from .sim.closed_form_errors import with_closed_form
    from .sim.simulate import scene_of

    return [with_closed_form(scene_of(options.scene, options.overrides, options.seed))]


def _each_level(options: argparse.Namespace) -> Callable[[int, int], None]:
    """Progress of several recordings in turn, each with its own clock."""
    clocks: list = []

    def show(done: int, total: int) -> None:
        if not clocks or clocks[-1][0] >= done:
            clocks.append([done, _progress(options)("simulate")])
        clocks[-1][0] = done
        clocks[-1][1](done, total)

    return show


def _reconstruct(options: argparse.Namespace) -> int:
    if options.window is not None:
        return _reconstruct_in_windows(options)
    if options.overlap is not None:
        why, fix = "only windows have one", "add --window SECONDS, or leave it out"
        raise UsageError("an overlap of nothing", where="--overlap", why=why, fix=fix)
    from .data.read import read

    sequence = read(options.sequence, frame_rate_hz=options.frame_rate)
    device = start(options, compile_first=False)
    from .recon.train import chosen_settings, reconstruct

    chosen = _chosen(options)
    chosen_settings(sequence, options.preset, **chosen)  # refuses wrong ones before kernels compile
    compile_first_time(device)
    more = {**_named(options, "seed", "fresh"), "progress": _progress(options)("reconstruct")}
    print(reconstruct(sequence, options.out, options.preset, **chosen, device=device, **more).path)
    return 0


def _reconstruct_in_windows(options: argparse.Namespace) -> int:
    device = start(options)
    from .recon.windowed import reconstruct_in_windows

    run = reconstruct_in_windows(
        options.sequence,
        options.out,
        options.preset,
        window_s=options.window,
        overlap_s=options.overlap,
        frame_rate_hz=options.frame_rate,
        device=device,
        progress=_progress(options)("reconstruct"),
        **_named(options, "seed", "fresh"),
        **_chosen(options),
    )
    print(run.path)
    return 0


def _chosen(options: argparse.Namespace) -> dict[str, Any]:
    """What options change in a preset."""
    changes = list(options.set)
    if options.batch is not None:
        changes.append("schedule.batch=" + {1: "frame", 4: "quartet"}[options.batch])
    if options.deterministic:
        changes.append("render.deterministic=true")
    return {**_named(options, "images", "input", "ablation", "flow"), "changes": changes}


def _render(options: argparse.Namespace) -> int:
    if options.out is None and options.video is None:
        fix = "for example `gftorf render RUN --out pictures`"
        why = "pictures need a folder, a video a file"
        raise UsageError("--out or --video is missing", where="gftorf render", why=why, fix=fix)
    device = start(options)
    from .evaluate.video import checked
    from .evaluate.views import render_to_folder, render_to_video

    if options.video is not None:
        checked(options.video)  # before a folder is filled
    run = _opened(options, device)
    given = _named(options, "what", "times", "poses")
    if options.out is not None:
        files = _named(options, "out", "fresh", "arrays", "plain")
        progress = _progress(options)("render", unit="images")
        print(render_to_folder(run, **given, **files, progress=progress))
    if options.video is not None:
        progress = _progress(options)("video", unit="images")
        rate = {"rate_hz": options.rate}
        print(render_to_video(run, options.video, **given, **rate, progress=progress))
    return 0


def _export(options: argparse.Namespace) -> int:
    device = start(options)
    from .export.command import export

    given = _named(options, "out", "formats", "times", "every", "colour", "fresh")
    progress = functools.partial(_progress(options), unit="files")
    for path in export(_opened(options, device), **given, progress=progress):
        print(path)
    return 0


def _compare(options: argparse.Namespace) -> int:
    import json

    several, given = len(options.runs) > 1, _named(options, "truth", "frames", "against")
    if options.out is not None and not several:
        why = "the report of one run is written into its folder"
        raise UsageError("--out is for several runs", where="--out", why=why, fix="leave it out")
    device = start(options)
    runs, progress = (
        [_opened(options, device, path) for path in options.runs],
        _progress(options)("compare"),
    )
    if several:
        from .evaluate.runs import compare_runs, table_of_runs

        result = compare_runs(runs, options.out or "gftorf-compare", **given, progress=progress)
        print(json.dumps(result, indent=2) if options.json else table_of_runs(result))
        return 0
    from .evaluate.compare import compare
    from .evaluate.printed import table

    metrics = compare(runs[0], **given, progress=progress)
    print(json.dumps(metrics, indent=2) if options.json else table(metrics))
    return 0


def _view(options: argparse.Namespace) -> int:
    device = start(options)
    from .view.command import view

    say = functools.partial(print, flush=True)
    view(options.path, **_named(options, "port", "sequence"), device=device, say=say)
    return 0


def _sweep(options: argparse.Namespace) -> int:
    from .sweep.plan import read_plan

    plan = read_plan(options.plan)
    if options.dry_run:
        some = plan if options.rows is None else plan.only(options.rows)
        print("\n".join(job.id for job in (*some.recordings, *some.fits)))
        return 0
    device = start(options)
    from .sweep.command import TABLE, sweep
    from .sweep.table import exit_code

    given = _named(options, "out", "rows", "workers", "scheduler")
    devices = _gpus() if device != "cpu" and ":" not in options.device else [device]
    results = sweep(plan, **given, devices=devices, progress=_progress(options)("sweep"))
    print((Path(options.out) / TABLE).read_text(encoding="utf-8"), end="")
    return exit_code(results.values())


def _reproduce(options: argparse.Namespace) -> int:
    from .sweep import reproduce

    if options.list or options.name is None:
        print(reproduce.listed(reproduce.stated_results()))
        return 0
    stated = reproduce.stated_result(options.name)
    options.device = stated.device if options.device == "auto" else options.device
    given = {**_named(options, "out", "seeds"), "progress": _progress(options)("reproduce")}
    reproduced = reproduce.reproduce(stated, device=start(options), **given)
    print((reproduce.as_json if options.json else reproduce.table)(stated, reproduced))
    return 0 if all(one.within for one in reproduced) else 1


def _gpus() -> list[str]:
    """All GPUs of this machine."""
    import torch

    return [f"cuda:{k}" for k in range(torch.cuda.device_count())]


def _opened(options: argparse.Namespace, device: str, path: str | None = None) -> Run:
    """The run of a command, or one of several, with its sequence where --sequence says."""
    from .recon.run import Run

    run = Run.open(path or options.run_folder, device)
    return run if options.sequence is None else run.linked(options.sequence)


def _check(options: argparse.Namespace) -> int:
    from .data.check import check

    print(check(options.sequence, options.sheet, rules=[_lens]))
    if options.preset is not None:
        from .data.read import read
        from .recon.suitable import about_preset
        from .recon.train import chosen_settings

        sequence = read(options.sequence)
        given = options.preset, None, "auto", None, None, ()
        print(about_preset(sequence, chosen_settings(sequence, *given)))
    return 0


def _lens(sequence: Sequence, report: Report) -> None:
    """Lens that folds inside the image, by the camera of a reconstruction."""
    if sequence.intrinsics.distortion is None:
        return
    from .scene.measured import camera_of

    try:
        camera_of(sequence, 0)
    except InputError as error:
        report.warn("lens", f"{error.what}: {error.why}; {error.fix}")


def _import(options: argparse.Namespace) -> int:
    from .importers import command

    if options.list:
        for kind in command.KINDS.values():
            print(f"{kind.name:<12}{kind.about}")
        return 0
    if options.kind is not None and options.template:
        print(command.template_of(options.kind, options.out), end="" if not options.out else "\n")
        return 0
    needed = {"KIND": options.kind}
    needed |= {} if options.template else {"SRC": options.source}
    needed |= {} if options.template or options.dry_run else {"--out SEQ": options.out}
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        fix = "for example `gftorf import arrays quads --config quads.toml --out sequence`; "
        fix += "`gftorf import --list` shows the kinds"
        why, where = "it is needed", "gftorf import"
        raise UsageError(f"{' and '.join(missing)} missing", where=where, why=why, fix=fix)
    out = None if options.dry_run else options.out
    lines = command.import_recording(options.kind, options.source, out, options.config)
    print("\n".join(lines))
    if options.dry_run:
        print("nothing is written: --out SEQ in place of --dry-run writes it")
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from .doctor import doctor

    device = start(options, compile_first=False)
    passed, lines = doctor(device)
    print("\n".join(lines))
    return 0 if passed else 1


def _bench(options: argparse.Namespace) -> int:
    from pathlib import Path

    device = start(options)
    from .bench.command import Wanted, bench

    sequence, run = (path and Path(path) for path in (options.sequence, options.run))
    given = _named(options, "quick", "images", "preset")
    changes = tuple(options.set)
    wanted = Wanted(device=device, changes=changes, sequence=sequence, run=run, **given)
    say = functools.partial(print, flush=True)
    bench(options.parts, wanted, json=options.json, progress=_progress(options), say=say)
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    command.__name__[1:]: command
    for command in (
        _demo,
        _simulate,
        _import,
        _check,
        _reconstruct,
        _render,
        _export,
        _compare,
        _view,
        _sweep,
        _reproduce,
        _doctor,
        _bench,
    )
}


def _named(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    return {name: getattr(options, name) for name in names}


def _level(options: argparse.Namespace) -> int:
    return logging.WARNING if options.quiet else logging.DEBUG if options.verbose else logging.INFO


def _progress(options: argparse.Namespace) -> Callable[..., Callable[..., None]]:
    from .terminal import Progress

    return functools.partial(Progress, quiet=options.quiet)
