"""How a run was made: its config in words, and the commands that reproduce it."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
from collections.abc import Mapping
from typing import Any

from ..recon.settings import Method
from . import page

# facts that mean something for some methods only
METHODS_OF = {
    "input": {"gaussians", "torf", "ftorf", "volume"},
    "flow_source": {"gaussians", "flow2d", "ftorf", "volume"},
    "init": {"gaussians"},
    "motion": {"gaussians"},
}
INIT_WORDS = {
    "phase": "phase: Gaussians start on surfaces decoded from the measured quads, not at random",
    "quartets": "quartets: Gaussians at rest start on a background decoded from the measured "
    "quads, moving ones on points measured in every quartet",
    "random": "random: Gaussians start at random points in view",
}
METHOD_WORDS = {
    "gaussians": "moving Gaussians, fitted to the measurement by gradient descent",
    "ctof": "the closed form of every quartet, shown as if it were a reconstruction; nothing was "
    "fitted",
    "temporal": "the closed form of the mean over time where a quartet agrees with its pixel's "
    "median, and of the quartet elsewhere; nothing was fitted",
    "flow2d": "the closed form of quartets whose raw frames optical flow brought to one time; "
    "nothing was fitted",
    "torf": "a neural volume, a part of it at rest and a part in motion, fitted to phasors and "
    "colour by gradient descent; our own code after TöRF",
    "ftorf": "a neural volume with 3D scene flow, fitted to raw quads at their own times by "
    "gradient descent; our own code after F-TöRF",
    "volume": "a neural volume (ours) of hash grids with 3D scene flow, fitted to raw quads at "
    "their own times by gradient descent; after no publication",
}
INPUT_WORDS = {
    "quads": "quads: every raw frame at its own time and phase shift",
    "phasor": "phasor: real and imaginary part of every quartet, its raw frames taken as "
    "simultaneous",
}
MOTION_WORDS = {
    "network": "network: an MLP of position and time predicts one offset per Gaussian and "
    "quartet, linear in between",
    "nodes": "nodes: Gaussians follow a few moving nodes with one offset per quartet, linear in "
    "between; no network",
    "spline": "spline: Gaussians follow a few moving nodes along splines in time, with a control "
    "point per quartet",
    "rigid_nodes": "rigid_nodes: Gaussians follow a few nodes that rotate and move, with one "
    "rotation and offset per quartet",
    "windows": "windows: every quartet has moving Gaussians of its own, which move in a straight "
    "line",
    "still": "still: nothing moves, a control",
}
FLOW_WORDS = {
    "file": "file: optical flow that came with the sequence",
    "computed": "computed: optical flow by OpenCV, between quads of one shift",
    "tap sums": "tap sums: optical flow by OpenCV, between the light of both taps of raw frames",
    "none": "none",
}
WORDS = {
    "input": INPUT_WORDS,
    "init": INIT_WORDS,
    "motion": MOTION_WORDS,
    "flow_source": FLOW_WORDS,
}


def method_of(config: Mapping[str, Any]) -> str:
    """Method of a run: a name of ``METHOD_WORDS``."""
    return str(config.get("settings", {}).get("method", "gaussians"))


def fact(config: Mapping[str, Any], name: str) -> Any:
    """A value of a run's config or settings; None if absent or without meaning for the method."""
    if method_of(config) not in METHODS_OF.get(name, {method_of(config)}):
        return None
    return config.get(name, config.get("settings", {}).get(name))


def how(
    config: Mapping[str, Any],
    data_card: str | None,
    installed: str,
    *,
    compared: Mapping[str, Any],
    simulated: str | None = None,
) -> str:
    """A run's config in words, as HTML.

    Args:
        config: Content of config.json.
        compared: Content of metrics.json.
        simulated: Command that made the sequence; None if unknown.
        data_card: Statement on the truth in the sequence's README; None if it has none.
        installed: Versions of the software of the comparison.
    """
    method, size, scale = method_of(config), config.get("size_optimised"), config.get("quad_scale")
    known = {name: fact(config, name) for name in WORDS}
    worded = {name: WORDS[name].get(str(value), value) for name, value in known.items()}
    threads = "" if config.get("threads") is None else f", {config['threads']} threads"
    share = config.get("unfilled_share")
    length = f"{config.get('images')}, {config.get('seed')}"
    facts = {
        "sequence": config.get("sequence"),
        "SHA-256 of its data": config.get("data_sha256"),
        "SHA-256 of the checkpoint": compared.get("checkpoint_sha256"),
        "preset": config.get("preset"),
        "ablation": fact(config, "ablation"),
        "method": METHOD_WORDS.get(method, method),
        "fitted to": worded["input"],
        "initialisation": worded["init"],
        "motion": worded["motion"],
        "optical flow": worded["flow_source"],
        "optimised at": size
        and f"{size[0]}x{size[1]} pixels; scored at the sequence's own resolution",
        "quad scale": None if scale is None else f"{scale:.6g} ({config.get('quad_scale_source')})",
        "without optical flow": share and f"{100.0 * share:.2f} % of the pixels",
        "images, seed": length if Method(method).fits else None,
        "as published": "; ".join(config.get("faithful", ())) or None,
        "assumed or different": "; ".join(config.get("assumed", ())) or None,
        "device": config.get("device") and f"{config['device']}{threads}",
        "reconstructed by": f"gftorf-warp {config.get('version')}",
        "compared by": installed,
        "ground truth": data_card,
    }
    present = {name: value for name, value in facts.items() if value is not None}
    rows = "".join(f"<dt>{name}</dt><dd>{page.escape(v)}</dd>" for name, v in present.items())
    command = "\n".join(filter(None, [simulated, _command(config), _compare_command(compared)]))
    everything = json.dumps(config, indent=2, sort_keys=True, default=str)
    return (
        f"<dl>{rows}</dl><h3>To reproduce</h3><pre>{page.escape(command)}</pre>"
        f"<details><summary>config.json</summary><pre>{page.escape(everything)}</pre></details>"
    )


def _compare_command(metrics: Mapping[str, Any]) -> str:
    """The command that reproduces the comparison."""
    usual = {"frames": ("protocol", "all"), "against": ("against", "geometry")}
    given = {option: metrics.get(key) or default for option, (key, default) in usual.items()}
    words = [f" --{o} {shlex.quote(str(v))}" for o, v in given.items() if v != usual[o][1]]
    return "gftorf compare RUN" + "".join(words)


def _command(config: Mapping[str, Any]) -> str:
    """The command that reproduces the run; of an excerpt, for which there is none, what it is."""
    if excerpt := config.get("excerpt"):
        first, end = excerpt
        return (
            f"# raw frames {first} to {end - 1} of {str(config.get('sequence'))!r}, which no "
            "command reconstructs alone: a window of a longer run comes from the command of that "
            f"run, another excerpt from Sequence.open(..., frames=range({first}, {end}))"
        )
    options = {name: config.get(name) for name in ("preset", "images", "seed", "device")}
    if Method(method_of(config)).fits:
        more = {name: fact(config, name) for name in ("ablation", "input")}
        options |= {name: value for name, value in more.items() if value is not None}
    else:
        del options["images"], options["seed"]
    if windows := config.get("windows"):
        options["images"] = config["settings"]["schedule"]["images"]  # of each of them
        options["window"] = config.get("window_s", windows[0]["end_s"] - windows[0]["start_s"])
        options |= {"overlap": seconds} if (seconds := config.get("overlap_s")) is not None else {}
    if str(config.get("times") or "").startswith("setting"):
        options["frame-rate"] = config["frame_rate_hz"]
    words = list(options.items())
    words += [("flow", config["flow"])] if config.get("flow") else []
    words += [("set", change) for change in config.get("changes") or ()]
    typed = " ".join(f"--{name} {shlex.quote(str(value))}" for name, value in words)
    return f"gftorf reconstruct {shlex.quote(str(config.get('sequence')))} --out RUN {typed}"


def version_of(package: str) -> str:
    """Version of an installed package; one that merely lies on the path states none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"
