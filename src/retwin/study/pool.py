"""Jobs over processes, one torch thread each: threads beyond the cores cost several times."""

from __future__ import annotations

import multiprocessing
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from graphlib import TopologicalSorter
from typing import Any

from retwin.processes import worker_pool
from retwin.study.files import Job
from retwin.study.work import Work

__all__ = ["run_jobs"]

_progress: Any = None


def run_jobs(work: Work, processes: int, tell: Callable[[str, float], None]) -> None:
    """Do all jobs of `work` that are not done; an exception or Ctrl-C leaves what is finished."""
    graph = work.graph()
    shares = {job: float(work.files.path(job).exists()) for job in graph}
    missing = [job for job, share in shares.items() if not share]
    if not missing:
        return
    # Spawned, as the workers are.
    news = multiprocessing.get_context("spawn").Queue()
    stop = threading.Event()
    listener = threading.Thread(target=_listen, args=(news, shares, tell, stop), daemon=True)
    listener.start()
    try:
        with worker_pool(min(processes, len(missing)), _start_worker, (news,)) as pool:
            _finish(graph, set(missing), lambda job: pool.schedule(_do, args=(work, job)))
    finally:
        stop.set()
        # A worker ended in the middle of a message could keep the listener waiting.
        listener.join(timeout=1.0)


def _finish(
    graph: Mapping[Job, Sequence[Job]],
    missing: set[Job],
    start: Callable[[Job], Future[None]],
) -> None:
    """Start each job when those before it are done; the first failure is raised at once."""
    order = TopologicalSorter(graph)
    order.prepare()
    running: dict[Future[None], Job] = {}
    while order.is_active():
        for job in order.get_ready():
            if job in missing:
                running[start(job)] = job
            else:
                order.done(job)
        if running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                future.result()
                order.done(running.pop(future))


def _listen(
    news: Any,
    shares: dict[Job, float],
    tell: Callable[[str, float], None],
    stop: threading.Event,
) -> None:
    while not stop.is_set():
        try:
            job, share = news.get(timeout=0.2)
        except queue.Empty:
            continue
        shares[job] = max(shares[job], share)
        tell(str(job), sum(shares.values()) / len(shares))


def _start_worker(news: Any) -> None:
    import torch

    global _progress
    _progress = news
    torch.set_num_threads(1)
    # Recurrent nets run into denormal numbers, which are several times slower; must be first.
    torch.set_flush_denormal(True)


def _do(work: Work, job: Job) -> None:
    _progress.put((job, 0.0))
    work.do(job, lambda share: _progress.put((job, 0.99 * share)))
    _progress.put((job, 1.0))
