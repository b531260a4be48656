"""Time of one run of a trivial FMU with 1000 steps.

Target: at most 20 ms on one core. The table also shows FMPy alone, with an instance that is reset.
The FMU is that of the tests, compiled from C.
"""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import fmpy
import numpy as np
from fmpy.simulation import instantiate_fmu
from record import record

from retwin.twins.fmu.twin import FMUTwin

sys.path.append(str(Path(__file__).parents[1] / "tests"))
STEPS = 1000
RATE = 100.0
RUNS = 400


def ms_per_run(twin: FMUTwin) -> float:
    """Time per run, without the start of the worker processes."""
    commands = np.ones((RUNS, STEPS, 1))
    marks: list[float] = []
    twin.simulate(commands, seed=0, progress=lambda _: marks.append(time.perf_counter()))
    return 1000 * (marks[-1] - marks[0]) / (len(marks) - 1)


def ms_with_fmpy_alone(path: Path) -> float:
    folder = fmpy.extract(path)
    description = fmpy.read_model_description(folder)
    instance = instantiate_fmu(folder, description, "CoSimulation")
    grid = np.zeros(STEPS, dtype=[("time", "f8"), ("u", "f8")])
    grid["time"], grid["u"] = np.arange(STEPS) / RATE, 1.0
    times = []
    for _ in range(20):
        started = time.perf_counter()
        instance.reset()
        with redirect_stdout(StringIO()):  # it warns of inputs that are not set
            fmpy.simulate_fmu(
                folder,
                model_description=description,
                fmu_instance=instance,
                stop_time=(STEPS - 1) / RATE,
                output_interval=1 / RATE,
                input=grid,
                output=["x"],
                terminate=False,
            )
        times.append(time.perf_counter() - started)
    return 1000 * float(np.median(times))


def main() -> None:
    from fmus import c_fmu, python_fmu

    with tempfile.TemporaryDirectory() as folder:
        compiled, scripted = c_fmu(Path(folder)), python_fmu(Path(folder))
        one = FMUTwin.from_file(compiled, RATE, ["u"], ["x"], workers=1)
        rows = {
            "C, FMI 3, one worker (ms)": ms_per_run(one),
            "C, FMI 3, all cores (ms)": ms_per_run(FMUTwin.from_file(compiled, RATE, ["u"], ["x"])),
            "Python, FMI 2, one worker (ms)": ms_per_run(
                FMUTwin.from_file(scripted, RATE, ["u"], ["x"], workers=1)
            ),
            "C, FMI 3, FMPy alone (ms)": ms_with_fmpy_alone(compiled),
        }
    record("fmu", f"a run of {STEPS} steps, ms", rows)


if __name__ == "__main__":
    main()
