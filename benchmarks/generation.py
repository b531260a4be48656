"""Time of a balanced set of 3600 corrected, labelled trajectories, and of other sources.

Targets on two cores: at most 2 % of the time of the MuJoCo twin with steps of 1 ms, preferably 1 %;
in command space, with the sensor, at most 15 s; 2 GB of memory. All times are from one run; slow
sources generate fewer trajectories, and the time is scaled. Writing as many bytes to memory is the
lower bound. The argument is another number of trajectories.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path

from fmu import ms_per_run
from record import median_seconds, memory_bandwidth, peak_memory_gb, record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, ArmPiTwin
from retwin.cases.case import Case
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.twin import Twin

sys.path.append(str(Path(__file__).parents[1] / "tests"))
COUNT = 3600
FEW = 0.05
"""Share of the trajectories that slow twins generate."""
REPEATS = 9
"""Runs of which the median time is taken, because other work disturbs times of a second."""


def fmu_seconds(count: int) -> float:
    """Time in s of `count` runs of a trivial compiled FMU, on all cores."""
    from fmus import c_fmu

    with tempfile.TemporaryDirectory() as folder:
        twin = FMUTwin.from_file(c_fmu(Path(folder)), KINEMATIC.rate, ["u"], ["x"])
        return count * ms_per_run(twin) / 1000


def generating(
    twin: Twin, case: Case, count: int, *, share: float = 1.0, repeats: int = REPEATS
) -> float:
    """Median time in s for `count` labelled trajectories, scaled up from a `share` of them."""
    per_class = max(1, round(share * count / len(case.classes)))
    make = partial(rt.generate, twin, case, per_class=per_class, seed=2)
    return median_seconds(make, repeats) * count / (per_class * len(case.classes))


def main(count: int) -> None:
    case = rt.cases.armpi()
    twin = rt.generate(case.twin, case, per_class=100, seed=0)
    real = rt.generate(case.emulator, case, per_class=10, seed=1)
    ibg = rt.fit_surrogate(twin, seed=0)
    at_outputs, in_commands = (
        rt.CorrectedTwin(ibg, rt.fit_residual(ibg, real, operator, seed=0))
        for operator in (case.output_correction, case.correction)
    )
    slow = "MuJoCo, steps of 1 ms"
    closed = "closed form: kinematics behind a servo lag"
    measure = partial(generating, case=case, count=count)
    before = peak_memory_gb()
    seconds = {
        slow: measure(ArmPiTwin(step=0.001), share=FEW),
        "an FMU of one first-order lag": fmu_seconds(count),
        "corrected, CommandSpace and SampledSensor": measure(in_commands),
        "corrected, DelayOffset": measure(at_outputs),
        "surrogate alone": measure(ibg),
        closed: measure(KINEMATIC),
    }
    made = rt.generate(in_commands, case, per_class=max(1, count // len(case.classes)), seed=2)
    size = sum(each.nbytes for each in (made.commands, made.nominal, made.observed, made.mask))
    bound = size / memory_bandwidth()
    rows = {
        name: {
            "seconds": time,
            "% of MuJoCo": 100 * time / seconds[slow],
            "multiple of closed form": time / seconds[closed],
            "multiple of memory": time / bound,
        }
        for name, time in {**seconds, "writing its bytes to memory": bound}.items()
    }
    record("generation", f"{count} labelled trajectories of 10 s at 100 Hz, medians", rows)
    errors = ibg.fitted.figures if ibg.fitted else {}
    about = {
        "bytes of the set (GB)": size / 1e9,
        "memory bandwidth, one core (GB/s)": size / bound / 1e9,
        "peak memory before generating (GB)": before,
        "peak memory (GB)": peak_memory_gb(),
        **{f"error of the surrogate, {k} (mm RMS)": 1e3 * errors[f"rmse_{k}"] for k in "xyz"},
    }
    record("generation_set", "size of the set, and error of its surrogate", about)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT)
