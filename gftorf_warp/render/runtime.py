"""Warp in this process: its start, its messages in our log, and the lock of launches.

Warp's modules, tape and streams belong to the process. Two threads that launch at once can crash
while one of them loads a module, so the first launch of a kernel is made alone; on CUDA, where one
would set the stream of the other, every launch is. CPU threads render at the same time.
"""

from __future__ import annotations

import functools
import logging
import os
from typing import Any

import warp as wp

from ..kernels.making import LOCK

LOG = logging.getLogger("gftorf_warp")
LAUNCHING = LOCK
"""Held while kernels are made, during the first launch of each, and during all on CUDA."""
_LAUNCHED: set[tuple[wp.Kernel, int | None]] = set()
"""Kernels with block sizes that were launched on a CPU, so that their modules are loaded."""

if hasattr(
    os, "register_at_fork"
):  # a forked process must not inherit a lock that another thread holds
    _release = LAUNCHING.release
    os.register_at_fork(before=LAUNCHING.acquire, after_in_parent=_release, after_in_child=_release)


def launch(kernel: wp.Kernel, dim: Any, inputs: list, outputs: list, **options: Any) -> wp.Launch:
    """``wp.launch`` that no tape records. While a thread launches on CUDA, or a kernel for the
    first time, which may compile and load its module, no other one does so.
    """
    options["record_tape"] = False
    on_cpu = wp.get_device(options["device"]).is_cpu
    variant = kernel, options.get("block_dim")
    if on_cpu and variant in _LAUNCHED:
        return wp.launch(kernel, dim, inputs, outputs, **options)
    with LAUNCHING:
        command = wp.launch(kernel, dim, inputs, outputs, **options)
    if on_cpu:
        _LAUNCHED.add(variant)
    return command


class WarpLog:
    """Warp's messages in our log: compilations, but no kernels loaded from the cache."""

    def debug(self, message: str) -> None:
        """Pass on at the lowest level."""
        LOG.debug("warp: %s", message)

    def info(self, message: str) -> None:
        """Log compilations briefly and other messages in full, both at the lowest level."""
        text = message.strip()
        if text.endswith("(compiled)"):
            LOG.debug(
                "  compiled %s", text.removeprefix("Module ").removesuffix("(compiled)").strip()
            )
        else:
            self.debug(message)

    def warning(
        self,
        message: str,
        category: type[Warning] | None = None,  # noqa: ARG002
        stacklevel: int = 1,  # noqa: ARG002
    ) -> None:
        """Pass on as a warning."""
        LOG.warning("warp: %s", message)

    def error(self, message: str) -> None:
        """Pass on as an error."""
        LOG.error("warp: %s", message)


@functools.cache
def start() -> None:
    """Initialise Warp, once; a logger that the program has given to Warp stays."""
    with LAUNCHING:
        if type(wp.get_logger()).__module__.startswith("warp."):
            wp.set_logger(WarpLog())
        wp.init()
