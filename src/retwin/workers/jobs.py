"""Tasks: in this process, in worker processes, or on a Dask cluster.

All three call the same function with the same arguments; both kinds of workers give futures.
"""

from __future__ import annotations

import dataclasses
import pickle
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

from pebble import ProcessExpired

from retwin.catalog.modules import add_known, known
from retwin.checks import needs_extra
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.workers.pools import check_sendable, sendable_errors, worker_pool

ATTEMPTS = 3
"""How often a chunk is begun while worker processes die, before that is an error."""

Job = TypeVar("Job")
Result = TypeVar("Result")
Answer: TypeAlias = tuple[Result, list[tuple[str, type[Warning]]]]
"""What a worker sends: the result of a task, and the warnings that this process then gives."""


def each(
    task: Callable[..., Result],
    job: Job,
    numbers: Sequence[int],
    *,
    workers: int,
    scheduler: str | None,
    progress: Progress,
) -> Iterator[Result]:
    """The results of `task(job, number)` for all numbers, in the order of completion.

    A chunk whose worker process dies is done again by another one.

    Parameters
    ----------
    task : callable
        A function of the job, a number, and in this process also of `progress`.
    job : object
        What all tasks share; it is pickled for workers.
    numbers : sequence of int
        The chunks.
    workers : int
        The number of processes; with one, this process does the work.
    scheduler : str or None
        The address of a Dask scheduler, which replaces the worker processes.
    progress : callable
        Called with the share of one chunk that is done, in this process only.

    Raises
    ------
    InputError
        There is no scheduler at that address, the package distributed is missing, or the job cannot
        be pickled.
    RuntimeError
        Workers died `ATTEMPTS` times.
    Exception
        The first exception of a task; the other workers are then stopped.

    """
    if scheduler is None and workers == 1:
        yield from (task(job, number, progress) for number in numbers)
        return
    check_sendable(
        job,
        "plan",
        expected="a twin, sampler and faults that other processes can import",
        remedy="define them in a module of their own, or use one worker",
    )
    if scheduler is not None:
        with on_cluster(scheduler, task, job) as submit:
            yield from _as_they_come(submit, numbers)
    else:
        with worker_pool(workers) as pool:
            yield from _as_they_come(
                lambda number: pool.schedule(_in_worker, args=(task, job, number)), numbers
            )


def alone(twin: Any) -> Any:
    """A copy of a twin that starts no processes or threads of its own.

    Sets the fields `workers` and `threads` of dataclasses to 1, also of nested ones; the outputs of
    a twin do not depend on them.
    """
    if not dataclasses.is_dataclass(twin) or isinstance(twin, type):
        return twin
    changes = {}
    for field in dataclasses.fields(twin):
        value = getattr(twin, field.name)
        fewer = 1 if field.name in ("workers", "threads") else alone(value)
        if field.init and fewer is not value and fewer != value:
            changes[field.name] = fewer
    return dataclasses.replace(twin, **changes) if changes else twin


def _as_they_come(
    submit: Callable[[int], Future[Answer[Result]]], numbers: Sequence[int]
) -> Iterator[Result]:
    for _ in range(ATTEMPTS):
        futures = {submit(number): number for number in numbers}
        lost = []
        for future in as_completed(futures):
            try:
                result, given = future.result()
            except ProcessExpired:
                lost.append(futures[future])
            else:
                for message, category in given:
                    warnings.warn(message, category, stacklevel=2)
                yield result
        if not lost:
            return
        numbers = lost
    raise RuntimeError(
        f"worker processes died {ATTEMPTS} times on chunks {', '.join(map(str, numbers[:5]))}; "
        "the computer may be short of memory: use fewer workers or smaller chunks"
    )


@contextmanager
def on_cluster(
    address: str, task: Callable[..., Result], job: object
) -> Iterator[Callable[[Any], Future[Answer[Result]]]]:
    """A function that submits `task(job, argument)` to a Dask cluster.

    Parameters
    ----------
    address : str
        The address of the scheduler, such as `tcp://10.0.0.1:8786`.
    task : callable
        A function that workers can import.
    job : object
        What all tasks share; it is pickled and sent once.

    Raises
    ------
    InputError
        There is no scheduler at that address, the package distributed is missing, or its workers
        may not start processes, as the task does.
    RuntimeError
        Workers died of a task.

    """
    distributed = needs_extra("distributed", "scale", "speaks to a Dask scheduler")
    try:
        client = distributed.Client(address, set_as_default=False, timeout=20)
    except (OSError, ValueError) as error:
        raise InputError(
            "scheduler",
            expected="the address of a Dask scheduler, such as tcp://10.0.0.1:8786",
            got=f"{address} ({' '.join(str(error).split()) or type(error).__name__})",
            remedy="start it with `dask scheduler`, and check that this machine can reach it",
        ) from None
    with client:
        executor = client.get_executor(pure=False)
        # The job is sent once. As the result of a task it is made again if its worker dies.
        sent = client.submit(_same, (known(), pickle.dumps(job)), pure=False)
        try:
            yield lambda argument: executor.submit(_on_worker, task, sent, argument)
        except distributed.KilledWorker as error:
            raise RuntimeError(f"workers of the cluster died of a chunk: {error}") from None
        except AssertionError as error:
            if "daemonic" not in str(error):
                raise
            raise InputError(
                "scheduler",
                expected="workers that may start processes, as this twin does",
                got="daemonic ones",
                remedy="start them with DASK_DISTRIBUTED__WORKER__DAEMON=False",
            ) from None
        finally:
            # No waiting: after an error or Ctrl-C, tasks that have not begun are dropped.
            executor.shutdown(wait=False)


def _in_worker(task: Callable[..., Result], job: object, argument: Any) -> Answer[Result]:
    with sendable_errors(), warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("default")
        result = task(job, argument)
    return result, [(str(each.message), _sendable(each.category)) for each in given]


def _sendable(category: type[Warning]) -> type[Warning]:
    """The category of a warning, or a general one if the parent may not find its module."""
    own = category.__module__.partition(".")[0] in ("builtins", "retwin")
    return category if own else UserWarning


def _on_worker(
    task: Callable[..., Result], sent: tuple[dict[str, str], bytes], argument: Any
) -> Any:
    """As `_in_worker`, for a process that may not know the modules beside the user's case.

    The job is unpickled here: what goes wrong is then an exception of the task, not of Dask.
    """
    modules, job = sent
    add_known(modules)
    return _in_worker(task, pickle.loads(job), argument)


def _same(sent: Job) -> Job:
    return sent
