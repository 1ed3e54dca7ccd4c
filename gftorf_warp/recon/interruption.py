"""Ctrl-C and SIGTERM end a loop between two steps, after everything was stored."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

from ..errors import Terminated


@contextlib.contextmanager
def signals() -> Iterator[list[int]]:
    """A list, empty until Ctrl-C or SIGTERM puts its number there; the second one acts at once.
    Main thread only.
    """
    stop: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def first(received: int, _) -> None:
        stop.append(received)
        for number in numbers:
            signal.signal(number, before[number])

    for number in numbers:
        signal.signal(number, first)
    try:
        yield stop
    finally:
        for number in numbers:
            signal.signal(number, before[number])


def interruption(stop: list[int]) -> KeyboardInterrupt:
    """What to raise after a signal, given the list of :func:`signals`."""
    return Terminated() if signal.SIGTERM in stop else KeyboardInterrupt()
