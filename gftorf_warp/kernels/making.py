"""Kernels that are made for given constants when a thread first needs them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import TypeVar

F = TypeVar("F", bound=Callable)

LOCK = threading.RLock()
"""Held while Warp's modules change: while kernels are made, and while a module is loaded."""


def once(make: F) -> F:
    """A function that makes kernels once for equal arguments, whichever threads call it: Warp fails
    where one adds a kernel to a module that another one loads.
    """
    kept: dict = {}

    @functools.wraps(make)
    def made(*constants, **more):
        key = constants, *sorted(more.items())
        if key not in kept:
            with LOCK:
                if key not in kept:
                    kept[key] = make(*constants, **more)
        return kept[key]

    return made  # type: ignore[return-value]
