"""``gftorf sweep``: every job of a plan that is not done yet, and the table of all."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..data.files import atomic_write, write_json
from ..data.images import png_bytes
from ..data.lock import locked
from ..errors import InputError, ResourceError, UsageError
from . import table
from .cluster import Cluster
from .job import Result, Task, do
from .plan import Job, Plan, read_plan
from .sheet import sheet
from .workers import Lost, Workers, places

LOG = logging.getLogger("gftorf_warp")
STORE, NUMBERS, TABLE, PAGE = "results.jsonl", "sweep.json", "sweep.md", "sweep.html"
PICTURES = "pictures"
Progress = Callable[..., None]


def sweep(
    plan: Plan | str | Path,
    out: str | Path,
    *,
    rows: Sequence[str] | None = None,
    devices: Sequence[str] = ("cpu",),
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Result]:
    """Simulate, reconstruct and score all that a plan lists, and write tables of it.

    What is done with the same settings and data is not done again, and a run that was interrupted
    goes on from its checkpoint: the same call continues a sweep. OUT has ``scenes/``, ``runs/``
    (folders of ordinary runs), ``results.jsonl`` (a line per job, as they are ready), and at the
    end ``sweep.md``, ``sweep.json``, ``sweep.html`` and ``pictures/SCENE.png``.

    Args:
        plan: What to do, or its TOML file.
        out: Folder to write.
        rows: Names of the rows to do now; None: all. The tables have all rows, the others as they
            are stored.
        devices: GPUs of this machine, or its CPU; of a cluster, what its workers have.
        workers: Number of processes here; None: one per GPU, or one per two CPUs.
        scheduler: Address of a Dask scheduler whose workers do the jobs; None: this machine.
        progress: Called with (jobs done, jobs in all).

    Returns:
        Results by the id of their job. Those that failed have ``error``.

    Raises:
        InputError: If the TOML file is no plan, or a stored result is damaged.
        UsageError: If the number of processes makes no sense, or there is no row of a name.
        ResourceError: If no scheduler answers.
        BusyError: If another sweep works in ``out``.
    """
    if workers is not None and workers < 1:
        why = f"expected at least one process, got {workers}"
        raise UsageError("no workers", where="--workers", why=why, fix="leave it out")
    if not isinstance(plan, Plan):
        plan = read_plan(plan)
    now = plan if rows is None else plan.only(rows)
    out = Path(out).resolve()
    out.mkdir(parents=True, exist_ok=True)
    with (
        locked(out, ".sweep.lock", "sweep"),
        _executor_of(now, devices, workers, scheduler) as executor,
    ):
        results = read_results(out / STORE)
        done, total = 0, len(now.recordings) + len(now.fits)
        for jobs in (now.recordings, now.fits):
            tasks = [Task(job=job, plan=plan, out=out, known=_key(results, job)) for job in jobs]
            for task, outcome in _outcomes(executor, tasks, results):
                result = _result(task, outcome)
                if "error" in result or result["key"] != _key(results, task.job):
                    _store(out / STORE, result)
                    results[task.job.id] = result
                done += 1
                _say(done, total, result)
                if progress is not None:
                    progress(done, total)
        every = (job.id for job in (*plan.recordings, *plan.fits))
        wanted = {id: results[id] for id in every if id in results}
        write_json(out / NUMBERS, list(wanted.values()))
        atomic_write(out / TABLE, table.markdown(plan, wanted).encode())
        sheets = {scene.name: sheet(plan, scene, out, wanted) for scene in plan.scenes}
        for name, picture in sheets.items():
            if picture is not None:
                atomic_write(out / PICTURES / f"{name}.png", png_bytes(picture))
        atomic_write(out / PAGE, table.html(plan, wanted, sheets).encode())
    return wanted


def _executor_of(
    plan: Plan, devices: Sequence[str], workers: int | None, scheduler: str | None
) -> Workers | Cluster:
    """What does the jobs: processes of this machine, no more than there are fits, or a cluster."""
    if scheduler is not None:
        return Cluster(scheduler, devices[0].partition(":")[0], do)
    here = places(list(devices), workers)
    count = min(len(here), len(plan.fits))
    return Workers(places(list(devices), count), do)


def _outcomes(
    executor: Workers | Cluster, tasks: list[Task], results: dict[str, Result]
) -> Iterator[tuple[Task, Any]]:
    """Tasks with their outcomes; at once, without an attempt, where the scene was not simulated."""
    possible = []
    for task in tasks:
        simulated = results.get(Job(scene=task.job.scene).id, {})
        if task.job.row is not None and task.job.scene.sequence is None and "error" in simulated:
            yield task, {**simulated, "error": f"without its scene: {simulated['error']}"}
        else:
            possible.append(task)
    yield from executor.outcomes(possible)


def _result(task: Task, outcome: Any) -> Result:
    known = {"id": task.job.id, "scene": task.job.scene.name, "seed": task.job.seed}
    if isinstance(outcome, Lost):
        return known | {"error": outcome.why, "exit_code": ResourceError.exit_code}
    return outcome | known


def _key(results: dict[str, Result], job: Job) -> str | None:
    """Key of a stored result that is good."""
    stored = results.get(job.id, {})
    return None if "error" in stored else stored.get("key")


def read_results(path: Path) -> dict[str, Result]:
    """The last complete line of every job; none without the file.

    Raises:
        InputError: If another line than the last one is damaged.
    """
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    results: dict[str, Result] = {}
    for number, line in enumerate(lines, 1):
        if line.endswith(b"\n"):
            result = _read_line(line, path, number)
            results[result["id"]] = result
    return results


def _read_line(line: bytes, path: Path, number: int) -> Result:
    """One result."""
    try:
        result: Result = json.loads(line)
        if isinstance(result["id"], str) and ("error" in result or "key" in result):
            return result
        why = "expected an object with an id and a key or an error"
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        why = f"expected the result of a job as JSON: {type(error).__name__}: {error}"[:200]
    fix = "restore the file from a copy, or remove the line: its job is then scored again"
    raise InputError("a damaged result", where=f"{path}, line {number}", why=why, fix=fix)


def _store(path: Path, result: Result) -> None:
    """Append a line; one that a crash cut off before is ended."""
    with path.open("a+b") as file:
        if file.tell():
            file.seek(-1, 2)
            if file.read(1) != b"\n":
                file.truncate(path.read_bytes().rfind(b"\n") + 1)
        file.write(json.dumps(result).encode() + b"\n")


def _say(done: int, total: int, result: Result) -> None:
    about = result.get("error", "as stored")
    if "refused" in result:
        about = f"not applied: {result['refused']}"
    if "metrics" in result:
        error = result["metrics"].get("d_mse_x100")
        scored = "no truth" if error is None else f"d {error:.4g}"
        about = f"{scored}, {result['wall_s']:.1f} s"
    elif not {"error", "refused", "row"} & result.keys():
        about = f"simulated, {result['wall_s']:.1f} s"
    LOG.info("%d/%d %s: %s", done, total, result["id"], about)
