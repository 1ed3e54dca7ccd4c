"""How a run was made, in words: what its config says, and the commands that make it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from . import page

OF_GAUSSIANS = {"input", "flow_source", "init", "motion"}  # facts of an optimisation; others have a mere default there
INIT_WORDS = {
    "phase": "phase: Gaussians start on surfaces decoded from the measured quads, not at random",
    "random": "random: Gaussians start anywhere in view",
}
METHOD_WORDS = {
    "gaussians": "moving Gaussians, fitted to the measurement by gradient descent",
    "ctof": "the closed form of every quartet, shown as if it were a reconstruction; nothing was fitted",
}
INPUT_WORDS = {
    "quads": "quads: every raw frame at its own time, in the one slot that it measured",
    "phasor": "phasor: real and imaginary part of every quartet, as if its four raw frames were of one instant",
}
MOTION_WORDS = {
    "network": "network: an MLP of position and time predicts one offset per Gaussian and quartet, linear in between",
    "nodes": "nodes: Gaussians follow a few moving nodes with one offset per quartet, linear in between; no network",
    "still": "still: nothing moves, a control",
}
FLOW_WORDS = {
    "file": "file: optical flow that came with the sequence",
    "computed": "computed: optical flow by OpenCV, between quads of one shift",
    "none": "none",
}


def method_of(config: Mapping[str, Any]) -> str:
    """What kind of reconstruction a run is: ``gaussians`` or ``ctof``."""
    return str(config.get("settings", {}).get("method", "gaussians"))


def fact(config: Mapping[str, Any], name: str) -> Any:
    """A value of a run's config, or of its settings; None if it has none, or means nothing for the method."""
    if name in OF_GAUSSIANS and method_of(config) != "gaussians":
        return None
    return config.get(name, config.get("settings", {}).get(name))


def how(config: Mapping[str, Any], data_card: str | None, installed: str) -> str:
    """What a run's config says about it, in words, as HTML.

    Args:
        config: Content of config.json.
        data_card: What the sequence's README says about its truth; None if it has none.
        installed: Versions of the programs that compared.
    """
    method = method_of(config)
    facts = {
        "sequence": config.get("sequence"),
        "preset": config.get("preset"),
        "ablation": fact(config, "ablation"),
        "method": _in_words(METHOD_WORDS, method),
        "compared with": _in_words(INPUT_WORDS, fact(config, "input")),
        "initialisation": _in_words(INIT_WORDS, fact(config, "init")),
        "motion": _in_words(MOTION_WORDS, fact(config, "motion")),
        "optical flow": _in_words(FLOW_WORDS, fact(config, "flow_source")),
        "optimised at": _times(config.get("size_optimised"), "pixels; scored at the sequence's own resolution"),
        "quad scale": _with_source(config.get("quad_scale"), config.get("quad_scale_source")),
        "images, seed": f"{config.get('images')}, {config.get('seed')}" if method == "gaussians" else None,
        "device": _with_threads(config.get("device"), config.get("threads")),
        "reconstructed by": f"gftorf-warp {config.get('version')}",
        "compared by": installed,
        "ground truth": data_card,
    }
    rows = "".join(
        f"<dt>{name}</dt><dd>{page.escape(value)}</dd>" for name, value in facts.items() if value is not None
    )
    command = f"{_again(config)}\ngftorf compare RUN"
    everything = json.dumps(config, indent=2, sort_keys=True, default=str)
    return (
        f"<dl>{rows}</dl><h3>Again</h3><pre>{page.escape(command)}</pre>"
        f"<details><summary>config.json</summary><pre>{page.escape(everything)}</pre></details>"
    )


def _in_words(words: Mapping[str, str], name: object) -> object:
    return words.get(str(name), name)


def _times(size: Sequence[int] | None, text: str) -> str | None:
    return None if size is None else f"{size[0]}x{size[1]} {text}"


def _with_source(value: float | None, source: str | None) -> str | None:
    return None if value is None else f"{value:.6g} ({source})"


def _with_threads(device: str | None, threads: int | None) -> str | None:
    return device if threads is None else f"{device}, {threads} threads"


def _again(config: Mapping[str, Any]) -> str:
    """The command that reconstructs it."""
    options = {name: config.get(name) for name in ("preset", "images", "seed", "device")}
    if method_of(config) == "gaussians":
        options |= {name: fact(config, name) for name in ("ablation", "input") if fact(config, name) is not None}
    else:
        del options["images"], options["seed"]
    words = list(options.items())
    words += [("flow", config["flow"])] if config.get("flow") else []
    words += [("set", change) for change in config.get("changes") or ()]
    typed = " ".join(f"--{name} {shlex.quote(str(value))}" for name, value in words)
    return f"gftorf reconstruct {shlex.quote(str(config.get('sequence')))} --out RUN {typed}"
