"""Processor time of generation and inversion with the compiled kernels, and in torch.

The argument is a folder that `CorrectedTwin.save` wrote for the arm, in command space. Both are
measured in turn in one process, so that other work on the machine disturbs both alike; figures are
medians of the processor time of all threads (give OMP_NUM_THREADS=1 for that of one core).
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from unittest.mock import patch

import numpy as np
import torch

import retwin as rt
from retwin.twins.compiled import commands
from retwin.update.kernels import generation

COUNT = 3600
REPEATS = 3


def compared(what: str, make: Callable[[], object]) -> None:
    """Print the medians of both."""
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(REPEATS):
        for kernels, taken in seconds.items():
            with (
                patch.object(generation, "library", *([] if not kernels else [generation.library])),
                patch.object(commands, "library", *([] if not kernels else [commands.library])),
            ):
                if not kernels:
                    generation.library.return_value = commands.library.return_value = None
                started = time.process_time()
                make()
                taken.append(time.process_time() - started)
    fast, slow = (statistics.median(seconds[each]) for each in (True, False))
    print(
        f"{what}: {fast:.2f} s with kernels, {slow:.2f} s in torch, {fast / slow:.2f}", flush=True
    )


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


if __name__ == "__main__":
    main(sys.argv[1])
