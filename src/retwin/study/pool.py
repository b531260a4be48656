"""`run_jobs`: jobs in worker processes with one torch thread each, or on a Dask cluster.

More threads than cores take several times as long.
"""

from __future__ import annotations

import json
import multiprocessing
import platform
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from graphlib import TopologicalSorter
from typing import Any

from retwin.checks import require
from retwin.study.files import Job, Roles
from retwin.study.progress import Stages
from retwin.study.work import Work
from retwin.workers.jobs import on_cluster
from retwin.workers.pools import worker_pool

_messages: Any = None
"""Queue to the parent process, set in each worker when it starts."""


def run_jobs(work: Work, processes: int, stages: Stages, scheduler: str | None = None) -> None:
    """Run all jobs that have no result yet, each when the jobs that it needs are done.

    An exception or Ctrl-C ends the workers; results that are finished remain.

    Parameters
    ----------
    work : Work
        The jobs.
    processes : int
        Number of worker processes, at least 1.
    stages : Stages
        Where progress is reported.
    scheduler : str, optional
        The address of a Dask scheduler, whose workers do the jobs in place of processes. They see
        the folder of the study at the same path.

    Raises
    ------
    InputError
        There is no such scheduler, or a worker does not see the folder.

    """
    graph = work.graph()
    shares = {job: float(work.files.path(job).exists()) for job in graph}
    missing = [job for job, share in shares.items() if not share]
    if not missing:
        return
    stages.begin(shares)
    if scheduler is not None:
        with on_cluster(scheduler, _do_on_cluster, work) as submit:
            _finish(graph, set(missing), submit, lambda job: stages.work(job, 1.0))
        return
    # Spawned, as the workers are.
    messages = multiprocessing.get_context("spawn").Queue()
    stop = threading.Event()
    listener = threading.Thread(target=_listen, args=(messages, stages, stop), daemon=True)
    listener.start()
    try:
        with worker_pool(min(processes, len(missing)), _start_worker, (messages,)) as pool:
            _finish(graph, set(missing), lambda job: pool.schedule(_do, args=(work, job)))
    finally:
        stop.set()
        # A worker that was ended in the middle of a message could keep the listener waiting.
        listener.join(timeout=1.0)


def _finish(
    graph: Mapping[Job, Sequence[Job]],
    missing: set[Job],
    start: Callable[[Job], Future[Any]],
    done: Callable[[Job], None] = lambda job: None,
) -> None:
    """Start each job when those that it needs are done; the first failure is raised at once."""
    order = TopologicalSorter(graph)
    order.prepare()
    running: dict[Future[Any], Job] = {}
    while order.is_active():
        for job in order.get_ready():
            if job in missing:
                running[start(job)] = job
            else:
                order.done(job)
        if running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                future.result()
                done(running[future])
                order.done(running.pop(future))


def _listen(messages: Any, stages: Stages, stop: threading.Event) -> None:
    """Report what the workers send until all is done, and what they sent last."""
    while True:
        try:
            stages.work(*messages.get(timeout=0.2))
        except queue.Empty:
            if stop.is_set():
                return


def _start_worker(messages: Any) -> None:
    global _messages
    _messages = messages
    _one_thread()


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)
    # Recurrent networks produce denormal numbers, which are several times slower. This must come
    # before any computation.
    torch.set_flush_denormal(True)


def _do(work: Work, job: Job) -> None:
    _messages.put((job, 0.0))
    work.do(job, lambda share: _messages.put((job, 0.99 * share)))
    _messages.put((job, 1.0))


def _do_on_cluster(work: Work, job: Job) -> None:
    _one_thread()
    roles = work.folder / "roles.json"
    seen = roles.read_text("utf-8") if roles.exists() else "no such file"
    fits = roles.exists() and Roles.of(json.loads(seen)) == work.roles
    expected = "a folder that all workers see at the same path"
    got = f"{roles}, of which {platform.node()} sees {'another one' if roles.exists() else seen}"
    remedy = "share the folder with all machines of the cluster, or leave --scheduler out"
    require(fits, "out", expected=expected, got=got, remedy=remedy)
    work.do(job)
