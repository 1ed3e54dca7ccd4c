"""One process at a time in a folder: a lock that the system releases when the process ends."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import BusyError


@contextmanager
def locked(folder: Path, name: str, what: str) -> Iterator[None]:
    """Hold the lock file ``name``, which names process and host, in a folder of ``what``.

    A missing folder is created; the file stays, unless the caller removes it while it is held.

    Raises:
        BusyError: If another process, or another call in this one, holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("a+") as file:
        if not (_try_lock(file.fileno()) and _is_named(file.fileno(), folder / name)):
            file.seek(0)
            why = f"its lock is held by {file.read().strip() or 'an unknown process'}"
            fix, what = "wait for it, stop it, or choose another --out", f"this {what}"
            raise BusyError(f"another process works on {what}", where=folder, why=why, fix=fix)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def _is_named(descriptor: int, path: Path) -> bool:
    """Whether an open file still has its name: who held the lock may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _try_lock(descriptor: int) -> bool:
    """Whether the system's lock on an open file was free; always, on systems without locks."""
    try:
        import fcntl
    except ImportError:  # not a Unix
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
