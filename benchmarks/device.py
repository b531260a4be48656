"""Records on a torch device: seconds from commands to records that stay there, by the clock.

The arguments are a folder that `CorrectedTwin.save` wrote for the arm, and a device such as "cuda";
without it, the processor, whose figures say only that the path works: `CorrectedTwin.simulate` is
the way to simulate there. On another device a million trajectories are simulated, too.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Sequence

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.update import DeviceTwin

COUNT, MANY = 3600, 1_000_000
REPEATS = 5


def seconds(
    twin: DeviceTwin, commands: torch.Tensor, faults: Sequence[rt.Fault | None] | None, repeats: int
) -> float:
    """The median of `repeats` times after a first one, waiting for the device."""
    taken = []
    for _ in range(1 + repeats):
        started = time.perf_counter()
        made = twin.records(commands, faults=faults, seed=2)
        float(made.observed[-1, -1, -1])  # on the processor: all before it has been computed
        taken.append(time.perf_counter() - started)
        del made
    return statistics.median(taken[1:])


def main(folder: str, device: str = "cpu") -> None:
    case, updated = rt.cases.armpi(), rt.CorrectedTwin.load(folder)
    twin = DeviceTwin(updated, device)
    faults = [each for each in case.faults.values() for _ in range(COUNT // len(case.classes))]
    rng = np.random.default_rng(0)
    sent = case.sampler.sample(COUNT, rng=rng, onsets=updated.onsets)
    commands = torch.from_numpy(sent).to(twin.device)
    rows = {
        f"{COUNT} healthy": seconds(twin, commands, None, REPEATS),
        f"{COUNT} of all classes": seconds(twin, commands, faults, REPEATS),
    }
    if twin.device.type != "cpu":
        many = commands.repeat(-(-MANY // COUNT), 1, 1)[:MANY]
        rows[f"{MANY} healthy"] = seconds(twin, many, None, 1)
    name = torch.cuda.get_device_name() if twin.device.type == "cuda" else str(twin.device)
    record("device", f"seconds on {name}", rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
