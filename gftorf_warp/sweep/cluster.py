"""The jobs of a sweep on a Dask cluster, all of whose workers see the folder of the sweep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import ResourceError
from .job import Task, do
from .workers import TRIES, Lost, Place

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
GPU = "GPU"  # the resource that a worker offers: dask worker --resources GPU=1


def outcomes(address: str, tasks: Sequence[Task], device: str) -> Iterator[tuple[Task, Any]]:
    """Tasks with their results, or :class:`Lost`, in the order in which they are ready.

    A worker works on one job at a time for each GPU that it offers, on a CPU for each of its
    threads. Jobs of a lost worker are done again by others, from their checkpoints.

    Args:
        address: Of the scheduler, ``tcp://host:8786``.
        tasks: Jobs, whose folder all workers see.
        device: 'cpu' or 'cuda', of the workers.

    Raises:
        ResourceError: If Dask is not installed, or no scheduler answers.
    """
    distributed = _distributed()
    try:
        client: Client = distributed.Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ResourceError(
            "no Dask scheduler answers",
            where=f"--scheduler {address}",
            why=" ".join(str(error).split()),
            fix="start one with `dask scheduler`, and workers with `dask worker ADDRESS`",
        ) from error
    with client:
        place = Place(device)
        resources = {GPU: 1} if device != "cpu" else None
        futures = {
            client.submit(do, task, place, key=f"gftorf-{task.job.id}-{client.id}",
                          retries=TRIES - 1, resources=resources, pure=False): task
            for task in tasks
        }  # fmt: skip
        for future in distributed.as_completed(futures):
            failure = future.exception()
            outcome = future.result() if failure is None else Lost(_one_line(failure))
            yield futures[future], outcome


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise ResourceError(
            "Dask is not installed",
            where="--scheduler",
            why="jobs on other machines need the package distributed",
            fix="pip install 'gftorf-warp[cluster]', here and on all workers",
        ) from error
    return distributed


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
