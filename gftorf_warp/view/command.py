"""``gftorf view``: a viewer of a run or a sequence in a browser."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from pathlib import Path

import torch

from ..errors import Terminated
from .subject import Subject
from .window import Window

LOG = logging.getLogger("gftorf_warp")


def view(
    path: str | Path,
    *,
    port: int = 0,
    device: torch.device | str = "cpu",
    sequence: str | Path | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Show a run or a sequence until Ctrl-C; of an unfinished run, the newest state.

    It listens at 127.0.0.1 only, so only programs of this machine can connect.

    Args:
        path: Folder of a run or of a sequence.
        port: Where to listen; 0: any free port.
        device: Where the run is rendered.
        sequence: Where the sequence of the run is now; None: where it was.
        say: Takes the lines to print.

    Raises:
        InputError: If the folder is neither, or viser is not installed.
        UsageError: If the port is in use.
        Terminated: If SIGTERM ended it.
    """
    window = Window(Subject.open(path, device, sequence=sequence), port)
    try:
        say(f"open {window.address} (Ctrl-C ends it)")
        at = f"{window.port}:127.0.0.1:{window.port}"
        say(f"from another machine: ssh -L {at} {socket.gethostname()}, then the same address")
        window.run()
    except Terminated:  # a kind of KeyboardInterrupt, with an exit code of its own
        raise
    except KeyboardInterrupt:
        LOG.info("viewer closed")
    finally:
        window.close()
