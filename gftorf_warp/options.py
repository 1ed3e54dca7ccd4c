"""Commands and options of ``gftorf``, their types, and hints for misspelt names."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Callable
from typing import NoReturn

from . import __version__
from .errors import UsageError


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises :class:`UsageError`, with the nearest option as a hint."""

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
                fix=nearest(name, list(self._option_string_actions), f"see `{self.prog} --help`"),
            )
        return values


def parse(arguments: list[str]) -> argparse.Namespace:
    """Options of one command as attributes; ``command`` is its name.

    Raises:
        UsageError: If the command or an option is unknown, or a value is invalid.
    """
    command = next((a for a in arguments if not a.startswith("-")), None)
    parsers = command_parsers()
    if command is None:
        top_parser(parsers).parse(arguments)
        raise UsageError(
            "no command",
            where="gftorf",
            why=f"one of {', '.join(parsers)} is needed",
            fix="gftorf --help",
        )
    if command not in parsers:
        hint = nearest(command, list(parsers), "see `gftorf --help`")
        raise UsageError(
            f"unknown command {command}",
            where="gftorf",
            why=f"there are {', '.join(parsers)}",
            fix=hint,
        )
    rest = list(arguments)
    rest.remove(command)
    return parsers[command].parse(rest)


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


def command_parsers() -> dict[str, Parser]:
    """One parser per command, by name."""
    demo = _command(
        "demo", "simulate a moving scene, reconstruct it, and compare the two in a report"
    )
    demo.add_argument(
        "--out", metavar="DIR", default="gftorf-demo", help="folder to write (gftorf-demo)"
    )
    _device_options(demo)
    _seed_option(demo, "seed of the noise and of the optimiser (0)")
    demo.add_argument(
        "--size", metavar="WxH", type=_size, help="image size in pixels (the scene's own)"
    )
    demo.add_argument(
        "--frames",
        metavar="N",
        type=_positive,
        help="raw frames, four to a quartet (the scene's own)",
    )
    demo.add_argument(
        "--images", metavar="N", type=_positive, help="raw frames to optimise (the preset's own)"
    )
    _fresh_option(demo)

    simulate = _command("simulate", "write a sequence of asynchronous quads with its true distance")
    simulate.add_argument(
        "scene",
        metavar="SCENE",
        nargs="?",
        help="name of a scene, --list shows them, or a .toml file of one",
    )
    simulate.add_argument(
        "--list", action="store_true", help="list the scenes, or SCENE with its overrides"
    )
    simulate.add_argument("--out", metavar="SEQ", help="folder to write")
    simulate.add_argument(
        "--frames", metavar="N", type=_positive, help="raw frames (the scene's own number)"
    )
    simulate.add_argument(
        "--size", metavar="WxH", type=_size, help="image size in pixels (the scene's own)"
    )
    _seed_option(simulate, "seed of the noise (0)")
    layouts = "folder layout (ftorf): raw quads, one phasor per quartet, or our own layout"
    simulate.add_argument("--format", metavar="ftorf|torf|capture", default="ftorf", help=layouts)
    amounts = (
        "truth in a capture of engine mesh: usual, or all, with light by harmonic, z-depth "
        "and normals"
    )
    simulate.add_argument("--truth", metavar="usual|all", default="usual", help=amounts)
    levels = (
        "level of realism, sync, L0, L1, L2, L3 or L4: sets engine, noise, motion blur and bounces"
    )
    simulate.add_argument("--level", metavar="NAME", help=levels)
    ladder = (
        "record all levels into SEQ/sync, SEQ/L0 .. SEQ/L4 and print the closed form's "
        "error on each"
    )
    simulate.add_argument("--ladder", action="store_true", help=ladder)
    engines = "gaussian: splats cover the scene; mesh: rays meet its surfaces (gaussian)"
    simulate.add_argument("--engine", metavar="gaussian|mesh", default="gaussian", help=engines)
    bounces = "bounces of indirect light, with engine mesh (0: direct light only)"
    simulate.add_argument("--bounces", metavar="N", type=_whole, default=0, help=bounces)
    paths = "random paths per pixel for the light that bounces (64)"
    simulate.add_argument("--paths", metavar="N", type=_positive, default=64, help=paths)
    device = "where engine mesh traces (cpu)"
    simulate.add_argument(
        "--device", metavar="auto|cpu|cuda", type=_device, default="cpu", help=device
    )
    simulate.add_argument(
        "--sync", action="store_true", help="all quads of a quartet at one instant"
    )
    simulate.add_argument("--no-noise", dest="noise", action="store_false", help="an ideal sensor")
    simulate.add_argument("--flow", action="store_true", help="store exact optical flow too")
    blur = "samples in time of one exposure (1: no motion blur)"
    simulate.add_argument("--exposure-samples", metavar="N", type=_positive, default=1, help=blur)
    single = (
        "change one setting, for example sensor.f_mod_hz=30e6 or "
        "bodies.1.path.velocity=3,0,0 (may be repeated)"
    )
    simulate.add_argument(
        "--override",
        dest="overrides",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help=single,
    )
    _fresh_option(simulate)
    _threads_option(simulate)

    reconstruct = _command("reconstruct", "fit moving Gaussians to the raw quads of a sequence")
    reconstruct.add_argument("sequence", metavar="SEQ", help="folder of the sequence")
    reconstruct.add_argument(
        "--out", metavar="RUN", required=True, help="folder to write; an interrupted run is resumed"
    )
    presets = (
        "settings: demo, paper, released, fast, dgs, dgs_depth or ctof, the closed form (demo)"
    )
    reconstruct.add_argument("--preset", metavar="NAME", default="demo", help=presets)
    inputs = "fitted data: quads, phasor, or auto: as recorded (auto)"
    reconstruct.add_argument("--input", metavar="KIND", default="auto", help=inputs)
    rows = "apply a row of the ablation table: nobias, dd, h1, h1h2 or h1h2dd"
    reconstruct.add_argument("--ablation", metavar="ROW", help=rows)
    single = (
        "change one setting, for example init.reflectivity=0.5; config.json of a run names "
        "all (may be repeated)"
    )
    reconstruct.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], help=single
    )
    reconstruct.add_argument(
        "--images", metavar="N", type=_positive, help="raw frames to optimise (the preset's own)"
    )
    batch = "raw frames of a training step: 1, or 4 for a whole quartet (the preset's own)"
    reconstruct.add_argument("--batch", metavar="N", type=int, choices=(1, 4), help=batch)
    order = "sum gradients in a fixed order on CUDA, for bitwise reproducible runs; slower"
    reconstruct.add_argument("--deterministic", action="store_true", help=order)
    flows = "the folder's, computed, or none; auto: the folder's if it has any, else dis"
    reconstruct.add_argument(
        "--flow", metavar="KIND", help=f"auto, file, dis, deepflow or none: optical flow, {flows}"
    )
    _seed_option(reconstruct, "seed of the optimiser (0)")
    _frame_rate_option(reconstruct)
    _device_options(reconstruct)
    _fresh_option(reconstruct)

    render = _command("render", "write images of a reconstruction at any time")
    render.add_argument("run_folder", metavar="RUN", help="folder of the reconstruction")
    render.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    what = "any of distance,quads,phasor,colour (distance)"
    render.add_argument(
        "--what", metavar="A,B", type=_list_of(str), default=["distance"], help=what
    )
    render.add_argument(
        "--times",
        metavar="S,S",
        type=_list_of(_number),
        help="seconds since raw frame 0 (each frame)",
    )
    poses = (
        "world-to-camera matrices in a .npy file, or the sequence's novel views (each "
        "frame's own pose)"
    )
    render.add_argument("--poses", metavar="FILE|novel", help=poses)
    arrays = "one .npy file per channel with all images, many times as fast as pictures"
    render.add_argument("--arrays", action="store_true", help=arrays)
    _device_options(render)
    _fresh_option(render)

    compare = _command("compare", "score a reconstruction against the truth and write a report")
    compare.add_argument("run_folder", metavar="RUN", help="folder of the reconstruction")
    compare.add_argument(
        "--truth", metavar="SEQ", help="sequence with the true distance (the reconstructed one)"
    )
    conventions = (
        "true distance: geometry, or static-phasor, the closed form without motion and "
        "noise (geometry)"
    )
    compare.add_argument(
        "--against", metavar="geometry|static-phasor", default="geometry", help=conventions
    )
    compare.add_argument(
        "--json", action="store_true", help="print metrics.json instead of a table"
    )
    compare.add_argument(
        "--frames", metavar="all|ftorf13", default="all", help="which raw frames are scored (all)"
    )
    _device_options(compare)

    check = _command(
        "check", "read a sequence, list its contents and assumptions, warn about suspicious values"
    )
    check.add_argument("sequence", metavar="SEQ", help="folder of the sequence")

    doctor = _command("doctor", "print versions and devices, and test the renderer on this machine")
    _device_options(doctor)

    bench = _command("bench", "measure times: tables and JSON")
    parts = "renderer, motion, step, reconstruction, render (all of them)"
    bench.add_argument("parts", metavar="PART", nargs="*", help=parts)
    bench.add_argument(
        "--quick",
        action="store_true",
        help="small sizes and few runs, as a test of the benchmark itself",
    )
    bench.add_argument("--json", metavar="FILE", help="file of all results")
    bench.add_argument(
        "--sequence",
        metavar="SEQ",
        help="folder of a sequence (a simulated scene that slides past)",
    )
    state = "run whose state step and render use (one initialised from measured phase)"
    bench.add_argument("--run", metavar="RUN", help=state)
    lengths = "number of images of step, reconstruction and render (their defaults)"
    bench.add_argument("--images", metavar="N", type=_positive, help=lengths)
    bench.add_argument(
        "--preset",
        metavar="NAME",
        help="of step and reconstruction (released; on a CPU demo for the latter)",
    )
    single = "change one setting of step and reconstruction, as in reconstruct (may be repeated)"
    bench.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help=single)
    _device_options(bench)

    parsers = (demo, simulate, reconstruct, render, compare, check, doctor, bench)
    return {parser.prog.split()[-1]: parser for parser in parsers}


def _command(name: str, what: str) -> Parser:
    """A parser with the options of every command."""
    parser = Parser(prog=f"gftorf {name}", description=what, allow_abbrev=False)
    parser.set_defaults(command=name)
    loudness = parser.add_mutually_exclusive_group()
    loudness.add_argument(
        "-q", "--quiet", action="store_true", help="only results, warnings and errors"
    )
    loudness.add_argument(
        "-v", "--verbose", action="store_true", help="also what Warp compiles and loads"
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def _device_options(parser: Parser) -> None:
    text = "auto (default), cpu, or cuda; cuda:1 is the second GPU"
    parser.add_argument(
        "--device", metavar="auto|cpu|cuda", type=_device, default="auto", help=text
    )
    _threads_option(parser)


def _threads_option(parser: Parser) -> None:
    parser.add_argument(
        "--threads", metavar="N", type=_positive, help="CPU threads (as many as may be used)"
    )


def _seed_option(parser: Parser, text: str) -> None:
    parser.add_argument("--seed", metavar="S", type=_whole, default=0, help=text)


def _fresh_option(parser: Parser) -> None:
    parser.add_argument(
        "--fresh", action="store_true", help="start over in a folder that is not empty"
    )


def _frame_rate_option(parser: Parser) -> None:
    parser.add_argument(
        "--frame-rate", metavar="HZ", type=_rate, help="raw frames per second (the file's, or 120)"
    )


def _device(text: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not auto, cpu, cuda or cuda:N")
    return text


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a width and a height in pixels, such as 96x72"
        )
    return int(match[1]), int(match[2])


def _whole(text: str) -> int:
    if not re.fullmatch(r"\d{1,18}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def _positive(text: str) -> int:
    if not re.fullmatch(r"\d{1,18}", text) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def _number(text: str) -> float:
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", text.strip(), re.IGNORECASE):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return float(text)


def _rate(text: str) -> float:
    if not _number(text) > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return _number(text)


def _list_of(item: Callable[[str], object]) -> Callable[[str], list]:
    return lambda text: [item(part) for part in text.split(",")]


def nearest(name: str, names: list[str], otherwise: str) -> str:
    """A hint: the most similar of ``names``, else ``otherwise``."""
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]}?" if close else otherwise
