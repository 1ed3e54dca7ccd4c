"""Warp in this process: its start, its messages in our log, and the lock of launches.

Warp's modules, tape and streams belong to the process. Two threads that launch at once can crash
while one of them loads a module, and on CUDA one would set the stream of the other.
"""

from __future__ import annotations

import functools
import logging
import os
import threading

import warp as wp

LOG = logging.getLogger("gftorf_warp")
LAUNCHING = threading.RLock()
"""Held while kernels are launched; the threads of a launch (side_by_side.py) do not need it."""

if hasattr(
    os, "register_at_fork"
):  # a forked process must not inherit a lock that another thread holds
    _release = LAUNCHING.release
    os.register_at_fork(before=LAUNCHING.acquire, after_in_parent=_release, after_in_child=_release)


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
