"""Processor time with the compiled kernels and in torch, and of inversion without extrapolation.

The argument is a folder that `CorrectedTwin.save` wrote for the arm, in command space. Both are
measured in turn in one process, so that other work on the machine disturbs both alike; figures are
medians of the processor time of all threads (give OMP_NUM_THREADS=1 for that of one core).
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from unittest.mock import patch

import numpy as np
import torch

import retwin as rt
from retwin.diagnosis import fit_inversion
from retwin.inference import solver
from retwin.twins.compiled import commands
from retwin.update.kernels import generation

COUNT = 3600
REPEATS = 3


@contextmanager
def without_kernels() -> Iterator[None]:
    """Everything in torch and numpy."""
    with (
        patch.object(generation, "library", return_value=None),
        patch.object(commands, "library", return_value=None),
    ):
        yield


def without_extrapolation() -> AbstractContextManager[object]:
    """Gauss-Newton steps as they are, however slowly they converge."""
    return patch.object(solver, "LARGEST_RATIO", 0.0)


def compared(
    what: str,
    make: Callable[[], object],
    without: Callable[[], AbstractContextManager[object]] = without_kernels,
) -> None:
    """Print the medians of both."""
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(REPEATS):
        for whole, taken in seconds.items():
            with nullcontext() if whole else without():
                started = time.process_time()
                make()
                taken.append(time.process_time() - started)
    now, other = (statistics.median(seconds[each]) for each in (True, False))
    print(f"{what}: {now:.3f} s, {without.__name__} {other:.3f} s, {now / other:.2f}", flush=True)


def main(folder: str) -> None:
    case, twin = rt.cases.armpi(), rt.CorrectedTwin.load(folder)
    rt.generate(twin, case, per_class=4, seed=0)
    each = COUNT // len(case.classes)
    compared(f"{COUNT} corrected", lambda: rt.generate(twin, case, per_class=each, seed=2))
    compared(
        f"{COUNT} of the surrogate",
        lambda: rt.generate(twin.surrogate, case, per_class=each, seed=2),
    )
    sent = case.sampler.sample(12, rng=np.random.default_rng(3))
    real = case.emulator.simulate(sent, seed=3)
    context = twin.residual.context(twin.surrogate, np.ascontiguousarray(real.commands))
    measured = torch.as_tensor(real.observed.astype(np.float64)), torch.as_tensor(real.mask.copy())
    infer = twin.residual.correction.infer
    compared("inference of 12", lambda: infer(context, *measured))
    healthy = real.replace(labels=np.repeat("Healthy", len(real)))
    diagnoser = fit_inversion(twin.surrogate, twin.residual, healthy, case.faults)
    faulty = rt.generate(case.emulator, case, per_class=1, seed=4)

    def one_by_one() -> None:
        for i in range(len(faulty)):
            diagnoser.diagnose(faulty[i : i + 1])

    what = f"inversion of {len(faulty)}, one by one"
    compared(what, one_by_one)
    compared(what, one_by_one, without_extrapolation)


if __name__ == "__main__":
    main(sys.argv[1])
