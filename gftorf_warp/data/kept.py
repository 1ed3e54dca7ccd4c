"""Results of functions of a sequence that are kept as long as the sequence exists."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

KEPT_BYTES_MAX = 1 << 30  # [bytes] of quads; decoded quartets take up to three times as much
P = ParamSpec("P")
T = TypeVar("T")


def kept(function: Callable[P, T]) -> Callable[P, T]:
    """Cache a function of a sequence and of further hashable arguments, all given by position.

    Its results must not refer to the sequence and must not be changed.
    """
    results: weakref.WeakKeyDictionary[Any, dict[tuple, T]] = weakref.WeakKeyDictionary()

    @functools.wraps(function)
    def cached(*given: P.args, **named: P.kwargs) -> T:
        sequence: Any = given[0]
        if named or sequence.quads.nbytes > KEPT_BYTES_MAX:
            return function(*given, **named)
        known = results.setdefault(sequence, {})
        if given[1:] not in known:
            known[given[1:]] = function(*given, **named)
        return known[given[1:]]

    return cached
