"""Jobs over processes, one torch thread each: threads beyond the cores cost several times."""

from __future__ import annotations

import multiprocessing
import queue
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any

from retwin.processes import worker_pool
from retwin.study.jobs import Job, Work

__all__ = ["run_jobs"]

_progress: Any = None


def run_jobs(work: Work, processes: int, tell: Callable[[str, float], None]) -> None:
    """Do all jobs of `work` that are not done; an exception or Ctrl-C leaves what is finished."""
    stages = work.jobs()
    every = [job for stage in stages for job in stage]
    shares = {job: float(work.path(job).exists()) for job in every}
    missing = [[job for job in stage if not shares[job]] for stage in stages]
    if not any(missing):
        return
    # Spawned, as the workers are.
    news = multiprocessing.get_context("spawn").Queue()
    stop = threading.Event()
    listener = threading.Thread(target=_listen, args=(news, shares, tell, stop), daemon=True)
    listener.start()
    workers = min(processes, max(map(len, missing)))
    try:
        with worker_pool(workers, _start_worker, (news,)) as pool:
            for stage in missing:
                _finish({pool.schedule(_do, args=(work, job)) for job in stage})
    finally:
        stop.set()
        # A worker ended in the middle of a message could keep the listener waiting.
        listener.join(timeout=1.0)


def _finish(futures: set[Future[None]]) -> None:
    """Wait for all; the first failure is raised at once."""
    while futures:
        done, futures = wait(futures, return_when=FIRST_COMPLETED)
        for future in done:
            future.result()


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
        tell(job.name, sum(shares.values()) / len(shares))


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
