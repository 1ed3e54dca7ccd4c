"""Commands and options of ``gftorf``, their types, and hints for misspelt names."""

from __future__ import annotations

import argparse
import functools
import re
from collections.abc import Callable
from typing import Any, NoReturn

from . import __version__
from .errors import UsageError
from .similar import did_you_mean

FRESH = "start over in a folder that is not empty"
MOVED = "where the sequence of the run is now, if it was moved; RUN remembers it"
THREADS = "CPU threads (as many as may be used)"


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises :class:`UsageError`, with the nearest option as a hint."""

    @classmethod
    def of(cls, command: str, what: str) -> Parser:
        """The parser of a command, with the options of every command."""
        parser = cls(prog=f"gftorf {command}", description=what, allow_abbrev=False)
        parser.set_defaults(command=command)
        output = parser.add_mutually_exclusive_group()
        quiet, verbose = "only results, warnings and errors", "also what Warp compiles and loads"
        output.add_argument("-q", "--quiet", action="store_true", help=quiet)
        output.add_argument("-v", "--verbose", action="store_true", help=verbose)
        parser.flag("--debug", "show the traceback of an error")
        return parser

    def option(
        self,
        name: str,
        metavar: str,
        kind: Callable[[str], object],
        text: str,
        default: object = None,
        **more: Any,
    ) -> None:
        """Add an option with a value."""
        self.add_argument(name, metavar=metavar, type=kind, help=text, default=default, **more)

    def flag(self, name: str, text: str) -> None:
        """Add an option without a value."""
        self.add_argument(name, action="store_true", help=text)

    def change(self, name: str, text: str, dest: str) -> None:
        """Add an option NAME=VALUE that may be repeated."""
        self.add_argument(
            name, dest=dest, metavar="NAME=VALUE", action="append", default=[], help=text
        )

    def error(self, message: str) -> NoReturn:
        """Raise instead of exiting."""
        raise UsageError(
            "invalid options", where=self.prog, why=message, fix=f"see `{self.prog} --help`"
        )

    def parse(self, arguments: list[str]) -> argparse.Namespace:
        """Parse all arguments; an unknown one is an error with the nearest option as a hint."""
        values, unknown = self.parse_known_args(arguments)
        if unknown:
            name = unknown[0].partition("=")[0]
            kind = "option" if name.startswith("-") else "argument"
            raise UsageError(
                f"unknown {kind} {name}",
                where=self.prog,
                why=f"`{self.prog}` has no such {kind}",
                fix=did_you_mean(name, self._option_string_actions, f"see `{self.prog} --help`"),
            )
        return values


def parse(arguments: list[str]) -> argparse.Namespace:
    """Options of one command as attributes; ``command`` is its name.

    Raises:
        UsageError: If the command or an option is unknown, or a value is invalid or not UTF-8.
    """
    for argument in arguments:
        _refuse_other_encodings(argument)
    command = next((a for a in arguments if not a.startswith("-")), None)
    parsers = command_parsers()
    if command is None:
        top_parser(parsers).parse(arguments)
        why = f"one of {', '.join(parsers)} is needed"
        raise UsageError("no command", where="gftorf", why=why, fix="gftorf --help")
    if command not in parsers:
        hint = did_you_mean(command, parsers, "see `gftorf --help`")
        why = f"there are {', '.join(parsers)}"
        raise UsageError(f"unknown command {command}", where="gftorf", why=why, fix=hint)
    rest = list(arguments)
    rest.remove(command)
    return parsers[command].parse(rest)


def _refuse_other_encodings(argument: str) -> None:
    """Names go to JSON, EXR and HTML files, which hold UTF-8."""
    try:
        argument.encode("utf-8")
    except UnicodeEncodeError as error:
        shown = ascii(argument)
        why, fix = f"byte {error.start} is not UTF-8", "use another name, or a link of another name"
        raise UsageError("a name that cannot be stored", where=shown, why=why, fix=fix) from error


def top_parser(parsers: dict[str, Parser]) -> Parser:
    """The parser of ``gftorf --help``."""
    width = max(map(len, parsers))
    rows = "\n".join(f"  {name:<{width}}  {parser.description}" for name, parser in parsers.items())
    parser = Parser(
        prog="gftorf",
        usage="gftorf COMMAND [options]",
        description="Simulate and reconstruct scenes seen by a continuous-wave time-of-flight "
        "camera.",
        epilog=f"commands:\n{rows}\n\n`gftorf COMMAND --help` lists the options of one. Start "
        f"with `gftorf demo`.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"gftorf_warp {__version__}")
    return parser


@functools.cache  # the same for every call of `cli.main` in a program
def command_parsers() -> dict[str, Parser]:
    """One parser per command, by name."""
    demo = Parser.of(
        "demo", "simulate a moving scene, reconstruct it, and compare the two in a report"
    )
    demo.option("--out", "DIR", str, "folder to write (gftorf-demo)", "gftorf-demo")
    _device_options(demo)
    demo.option("--seed", "S", _whole, "seed of the noise and of the optimiser (0)", 0)
    demo.option("--size", "WxH", _size, "image size in pixels (the scene's own)")
    demo.option("--frames", "N", _positive, "raw frames, four to a quartet (the scene's own)")
    demo.option("--images", "N", _positive, "raw frames to optimise (the preset's own)")
    demo.flag("--fresh", FRESH)

    simulate = Parser.of(
        "simulate", "write a sequence of asynchronous quads with its true distance"
    )
    scenes = "name of a scene, --list shows them, or a .toml file of one"
    simulate.add_argument("scene", metavar="SCENE", nargs="?", help=scenes)
    simulate.flag("--list", "list the scenes, or SCENE with its overrides")
    simulate.option("--out", "SEQ", str, "folder to write")
    simulate.option("--frames", "N", _positive, "raw frames (the scene's own number)")
    simulate.option("--size", "WxH", _size, "image size in pixels (the scene's own)")
    simulate.option("--seed", "S", _whole, "seed of the noise (0)", 0)
    layouts = "folder layout (ftorf): raw quads, one phasor per quartet, or our own layout"
    simulate.option("--format", "ftorf|torf|capture", str, layouts, "ftorf")
    amounts = (
        "truth in a capture of engine mesh: usual, or all, with light by harmonic, z-depth and"
    )
    simulate.option("--truth", "usual|all", str, f"{amounts} normals", "usual")
    levels = (
        "level of realism, sync, L0, L1, L2, L3 or L4: sets engine, noise, motion blur and bounces "
        "where no option does"
    )
    simulate.option("--level", "NAME", str, levels)
    ladder = "record all levels into SEQ/sync, SEQ/L0 .. SEQ/L4 and print the closed form's error"
    simulate.flag("--ladder", f"{ladder} on each")
    engines = "gaussian: splats cover the scene; mesh: rays meet its surfaces (gaussian)"
    simulate.option("--engine", "gaussian|mesh", str, engines)
    bounces = "bounces of indirect light, with engine mesh (0: direct light only)"
    simulate.option("--bounces", "N", _whole, bounces)
    simulate.option(
        "--paths", "N", _positive, "random paths per pixel for the light that bounces (64)"
    )
    simulate.option("--device", "auto|cpu|cuda", _device, "where engine mesh traces (cpu)", "cpu")
    simulate.flag("--sync", "all quads of a quartet at one instant")
    simulate.add_argument(
        "--no-noise", dest="noise", action="store_false", default=None, help="an ideal sensor"
    )
    simulate.flag("--flow", "store exact optical flow too")
    simulate.flag("--taps", "store the sum of both taps too, in a capture")
    blur = "samples in time of one exposure (1: no motion blur)"
    simulate.option("--exposure-samples", "N", _positive, blur)
    examples = "for example sensor.f_mod_hz=30e6 or bodies.1.path.velocity=3,0,0"
    simulate.change("--override", f"change one setting, {examples} (may be repeated)", "overrides")
    simulate.flag("--fresh", FRESH)
    simulate.option("--threads", "N", _positive, THREADS)

    reconstruct = Parser.of("reconstruct", "fit moving Gaussians to the raw quads of a sequence")
    reconstruct.add_argument("sequence", metavar="SEQ", help="folder of the sequence")
    out = "folder to write; an interrupted run is resumed"
    reconstruct.option("--out", "RUN", str, out, required=True)
    presets = "settings: best, demo, paper, released, fast, dgs, dgs_depth, or without Gaussians "
    presets += "ctof, the closed form, temporal, the same averaged over time, and flow2d, the same "
    presets += "after optical flow, or neural volumes torf, ftorf and volume (best)"
    reconstruct.option("--preset", "NAME", str, presets, "best")
    inputs = "fitted data: quads, phasor, or auto: as recorded (auto)"
    reconstruct.option("--input", "KIND", str, inputs, "auto")
    rows = "apply a row of the ablation table: nobias, dd, h1, h1h2 or h1h2dd"
    reconstruct.option("--ablation", "ROW", str, rows)
    example = "for example init.reflectivity=0.5; config.json of a run names all"
    reconstruct.change("--set", f"change one setting, {example} (may be repeated)", "set")
    reconstruct.option("--images", "N", _positive, "raw frames to optimise (the preset's own)")
    batch = "raw frames of a training step: 1, or 4 for a whole quartet (the preset's own)"
    reconstruct.option("--batch", "N", int, batch, choices=(1, 4))
    order = "sum gradients in a fixed order on CUDA, for bitwise reproducible runs; slower"
    reconstruct.flag("--deterministic", order)
    flows = "the folder's, computed, or none; auto: the folder's if it has any, else dis"
    reconstruct.option(
        "--flow", "KIND", str, f"auto, file, dis, deepflow or none: optical flow, {flows}"
    )
    reconstruct.option("--seed", "S", _whole, "seed of the optimiser (0)", 0)
    window = "reconstruct a long recording in windows of at most so long; --images are per window"
    reconstruct.option("--window", "SECONDS", _number, window)
    overlap = "what neighbouring windows share, at least (two quartets)"
    reconstruct.option("--overlap", "SECONDS", _number, overlap)
    reconstruct.option("--frame-rate", "HZ", _rate, "raw frames per second (the file's, or 120)")
    _device_options(reconstruct)
    reconstruct.flag("--fresh", FRESH)

    render = Parser.of("render", "write images of a reconstruction at any time")
    render.add_argument("run_folder", metavar="RUN", help="folder of the reconstruction")
    render.option("--out", "DIR", str, "folder to write")
    video = "a .webm, .mp4, .gif or .webp file of what is rendered, with or in place of --out"
    render.option("--video", "FILE", str, video)
    rates = "pictures per second of the video (4 to 30, so that a few last 5 s)"
    render.option("--rate", "HZ", _rate, rates)
    render.option("--sequence", "SEQ", str, MOVED)
    what = "any of distance,distance_median,quads,phasor,colour (distance)"
    render.option("--what", "A,B", _list_of(str), what, ["distance"])
    moments = "seconds since raw frame 0 (each instant of the sequence)"
    render.option("--times", "S,S", _list_of(_number), moments)
    poses = "world-to-camera matrices in a .npy file, or the sequence's novel views"
    render.option("--poses", "FILE|novel", str, f"{poses} (each frame's own pose)")
    render.flag(
        "--arrays", "one .npy file per channel with all images, many times as fast as pictures"
    )
    render.flag("--plain", "previews without title, colour bar and enlargement")
    _device_options(render)
    render.flag("--fresh", FRESH)

    export = Parser.of("export", "write a reconstruction in the formats of other programs")
    export.add_argument("run_folder", metavar="RUN", help="folder of the reconstruction")
    export.option("--out", "DIR", str, "folder to write", required=True)
    export.option("--sequence", "SEQ", str, MOVED)
    formats = "any of ply (Gaussians), points, mesh, obj, exr, npz, html, webm, mp4, gif, webp, "
    formats += "colmap, nerfstudio, tum"
    export.option("--format", "A,B", _list_of(str), f"{formats} (ply)", ["ply"], dest="formats")
    export.option("--times", "S,S", _list_of(_number), moments)
    export.option("--every", "N", _positive, "every N-th instant of the sequence (1)", 1)
    colours = "of splats and points (colour if the run has any)"
    export.option("--colour", "colour|reflectivity", str, colours)
    _device_options(export)
    export.flag("--fresh", FRESH)

    compare = Parser.of("compare", "score a reconstruction against the truth and write a report")
    folders = "folder of the reconstruction; several of one sequence are compared side by side"
    compare.add_argument("runs", metavar="RUN", nargs="+", help=folders)
    out = "folder for comparison.html and .json of several runs (gftorf-compare)"
    compare.option("--out", "DIR", str, out)
    compare.option("--sequence", "SEQ", str, MOVED)
    compare.option("--truth", "SEQ", str, "sequence with the true distance (the reconstructed one)")
    conventions = "geometry, or static-phasor, the closed form without motion and noise (geometry)"
    against = f"true distance: {conventions}"
    compare.option("--against", "geometry|static-phasor", str, against, "geometry")
    compare.flag("--json", "print metrics.json (comparison.json) instead of a table")
    compare.option("--frames", "all|ftorf13", str, "which raw frames are scored (all)", "all")
    _device_options(compare)

    view = Parser.of("view", "show a run, also one that goes on, or a sequence in a browser")
    view.add_argument("path", metavar="RUN|SEQ", help="folder of a reconstruction or of a sequence")
    view.option("--port", "N", _whole, "port at 127.0.0.1 (any free one)", 0)
    view.option("--sequence", "SEQ", str, MOVED)
    _device_options(view)

    contents = "read a sequence, list its contents and assumptions, warn about suspicious values"
    check = Parser.of("check", contents)
    check.add_argument("sequence", metavar="SEQ", help="folder of the sequence")
    text = "picture to write: the middle quartet, and distances for every order of the shifts"
    check.option("--sheet", "FILE.png", str, text)
    check.option("--preset", "NAME", str, "whether it fits, what of it is not as published")

    importer = Parser.of("import", "write the recording of another camera or program as a capture")
    kind = "kind of recording, --list shows them"
    importer.add_argument("kind", metavar="KIND", nargs="?", help=kind)
    importer.add_argument("source", metavar="SRC", nargs="?", help="its file or folder")
    importer.flag("--list", "list the kinds")
    importer.option("--out", "SEQ", str, "folder to write; with --template a file")
    config = "TOML file with what the recording does not say itself"
    importer.option("--config", "FILE.toml", str, config)
    importer.flag("--template", "print such a file with comments, or write it to --out")
    importer.flag("--dry-run", "print what would be read and how, and write nothing")

    sweep = Parser.of(
        "sweep", "reconstruct and score scenes x presets x settings x seeds; goes on where it was"
    )
    plans = "TOML file: scenes, presets, seeds, settings, see docs/sweep.md"
    sweep.add_argument("plan", metavar="FILE", help=plans)
    sweep.option("--out", "DIR", str, "folder of runs and tables (gftorf-sweep)", "gftorf-sweep")
    sweep.option("--rows", "NAME,NAME", _list_of(str), "rows to do now; the table has all (all)")
    kinds = "auto (default), cpu, cuda for all GPUs; cuda:1 is the second one"
    sweep.option("--device", "auto|cpu|cuda", _device, kinds, "auto")
    processes = "processes (one per GPU, or per two CPUs)"
    sweep.option("--workers", "K", _positive, processes)
    addresses = "Dask scheduler, tcp://host:8786, whose workers do the jobs and see --out"
    sweep.option("--scheduler", "ADDRESS", str, addresses)
    sweep.flag("--dry-run", "list the jobs and do nothing")

    reproduce = Parser.of(
        "reproduce", "do a stated result again: exit code 1 if it is outside the stated spread"
    )
    reproduce.add_argument("name", metavar="NAME", nargs="?", help="its name, see --list")
    reproduce.flag("--list", "list the stated results")
    out = "new folder for its runs (gftorf-reproduce-NAME)"
    reproduce.option("--out", "DIR", str, out)
    seeds = "seeds of the optimiser (those of the result)"
    reproduce.option("--seeds", "N,N", _list_of(_whole), seeds)
    reproduce.flag("--json", "print JSON in place of a table")
    where = "auto (default): where it was measured, or cpu, or cuda; cuda:1 is the second GPU"
    reproduce.option("--device", "auto|cpu|cuda", _device, where, "auto")
    reproduce.option("--threads", "N", _positive, THREADS)

    doctor = Parser.of(
        "doctor", "print versions and devices, and test the renderer on this machine"
    )
    _device_options(doctor)

    bench = Parser.of("bench", "measure times: tables and JSON")
    parts = "renderer, motion, step, reconstruction, render (all of them)"
    bench.add_argument("parts", metavar="PART", nargs="*", help=parts)
    bench.flag("--quick", "small sizes and few runs, as a test of the benchmark itself")
    bench.option("--json", "FILE", str, "file of all results")
    bench.option(
        "--sequence", "SEQ", str, "folder of a sequence (a simulated scene that slides past)"
    )
    state = "run whose state step and render use (one initialised from measured phase)"
    bench.option("--run", "RUN", str, state)
    lengths = "number of images of step, reconstruction and render (their defaults)"
    bench.option("--images", "N", _positive, lengths)
    settings = "of step and reconstruction (released; on a CPU demo for the latter)"
    bench.option("--preset", "NAME", str, settings)
    where = "of step and reconstruction, as in reconstruct"
    bench.change("--set", f"change one setting {where} (may be repeated)", "set")
    _device_options(bench)

    parsers = (
        demo,
        simulate,
        importer,
        check,
        reconstruct,
        render,
        export,
        compare,
        view,
        sweep,
        reproduce,
        doctor,
        bench,
    )
    return {parser.prog.split()[-1]: parser for parser in parsers}


def _device_options(parser: Parser) -> None:
    text = "auto (default), cpu, or cuda; cuda:1 is the second GPU"
    parser.option("--device", "auto|cpu|cuda", _device, text, "auto")
    parser.option("--threads", "N", _positive, THREADS)


def _invalid(text: str, wanted: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"{text!r} is not {wanted}")


def _device(text: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", text):
        raise _invalid(text, "auto, cpu, cuda or cuda:N")
    return text


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if match is None:
        raise _invalid(text, "a width and a height in pixels, such as 96x72")
    return int(match[1]), int(match[2])


def _whole(text: str, least: int = 0) -> int:
    if not re.fullmatch(r"\d{1,18}", text) or int(text) < least:
        raise _invalid(text, f"a whole number of at least {least}")
    return int(text)


def _positive(text: str) -> int:
    return _whole(text, least=1)


def _number(text: str) -> float:
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", text.strip(), re.IGNORECASE):
        raise _invalid(text, "a number")
    return float(text)


def _rate(text: str) -> float:
    if not _number(text) > 0:
        raise _invalid(text, "above 0")
    return _number(text)


def _list_of(item: Callable[[str], object]) -> Callable[[str], list]:
    return lambda text: [item(part) for part in text.split(",")]
