"""The jobs of a sweep on a Dask cluster, all of whose workers see the folder of the sweep."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ..errors import ResourceError
from .workers import TRIES, Lost, Place

CONNECT_S = 10.0
GPU = "GPU"  # the resource that a worker offers: dask worker --resources GPU=1


class Cluster:
    """What :class:`Workers` is on one machine.

    A worker does one task at a time for each GPU that it offers, on a CPU for each of its threads.
    Tasks of a lost worker are done again by others, from their checkpoints.

    Args:
        address: Of the scheduler, ``tcp://host:8786``.
        device: 'cpu' or 'cuda', of the workers.
        work: As for :class:`Workers`; the package is installed on all of them.

    Raises:
        ResourceError: If Dask is not installed, or no scheduler answers.
    """

    def __init__(self, address: str, device: str, work: Callable[[Any, Place], Any]):
        self.place, self.work = Place(device), work
        try:
            import distributed
        except ImportError as error:
            raise ResourceError(
                "Dask is not installed",
                where="--scheduler",
                why="jobs on other machines need the package distributed",
                fix="pip install 'gftorf-warp[cluster]', here and on all workers",
            ) from error
        try:
            self.client = distributed.Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ResourceError(
                "no Dask scheduler answers",
                where=f"--scheduler {address}",
                why=" ".join(str(error).split()),
                fix="start one with `dask scheduler`, and workers with `dask worker ADDRESS`",
            ) from error

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()

    def outcomes(self, tasks: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Tasks with their outcomes, or :class:`Lost`, in the order in which they are ready."""
        import distributed

        resources = {GPU: 1} if self.place.device != "cpu" else None
        how = {"resources": resources, "retries": TRIES - 1, "pure": False}
        futures = {self.client.submit(self.work, task, self.place, **how): task for task in tasks}
        for future in distributed.as_completed(futures):
            failure = future.exception()
            yield futures[future], future.result() if failure is None else Lost(_line(failure))


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
