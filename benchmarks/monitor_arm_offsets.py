"""The detector of offsets alone, on the emulated arm of monitor_arm.py: what it finds by itself.

Twin, calibration, healthy and biased machines are those of monitor_arm.py. Only the healthy machine
is inferred, which takes minutes where the monitor with all its causes takes an hour. The monitor
averages the evidence of three detectors, so that a third of this one's is a lower bound of it:
alarms of the monitor come no later.
"""

from __future__ import annotations

import numpy as np
from monitor_arm import CALIBRATED, FITTED, HEALTHY, MACHINES, TRAJECTORIES, TWICE, made
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.diagnosis import fit_inversion
from retwin.monitor.detect.offsets import OffsetModel, biases, fit_offsets
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault

ARL, SHARE, ORDERS = 1000.0, 1 / 3, 20


def main() -> None:
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    healthy = made(case, FITTED, 1).replace(labels=np.repeat("Healthy", FITTED))
    rg = rt.fit_residual(ibg, healthy, case.correction, seed=0)
    faults: list[Fault] = [*biases(case.faults.values()), *biases(case.causes.values())]
    # An inversion needs a second class; any does, since offsets are those of the first.
    diagnoser = fit_inversion(ibg, rg, healthy, {"Healthy": None, "any": faults[0]})
    model = fit_offsets(diagnoser.diagnose(made(case, CALIBRATED, 2)).offset)
    print(f"kappa {model.kappa.round(3)}, degrees of freedom {model.degrees.round(1)}")
    offsets = diagnoser.diagnose(made(case, HEALTHY, 3)).offset
    rng, evidence = np.random.default_rng(0), watched(model, faults, offsets)
    shuffled = [watched(model, faults, rng.permutation(offsets)) for _ in range(ORDERS)]
    rows = {
        "healthy": {
            "trajectories": float(HEALTHY),
            "false alarms": float((evidence >= ARL).sum()),
            "largest evidence": float(evidence.max()),
            "false alarms, mean over random orders": float(
                np.mean([(each >= ARL).sum() for each in shuffled])
            ),
        }
    }
    for motor in range(4):
        biased = ActuatorBias(motor, (TWICE - 0.1, TWICE + 0.1))
        numbers = []
        for machine in range(MACHINES):
            own = diagnoser.diagnose(made(case, TRAJECTORIES, 100 + machine, biased)).offset
            alarms = np.flatnonzero(watched(model, faults, own) >= ARL)
            numbers += [float(alarms[0]) + 1] if len(alarms) else []
        rows[f"motor {motor + 1}, bias of 2 standard deviations"] = {
            "machines": float(MACHINES),
            "found": float(len(numbers)),
            "median trajectories": float(np.median(numbers)) if numbers else np.nan,
            "most trajectories": float(max(numbers)) if numbers else np.nan,
        }
    record("monitor arm offsets", "Emulated arm, a third of the evidence of offsets", rows)


def watched(model: OffsetModel, faults: list[Fault], offsets: NDArray) -> NDArray:
    """The share of the evidence after each trajectory, begun anew after an alarm."""
    found = []
    state = np.zeros(())
    for factor in np.exp(model.ratio(offsets, faults)):
        state = (state + 1) * factor
        found.append(SHARE * float(state.mean()))
        if found[-1] >= ARL:
            state = np.zeros(())
    return np.array(found)


if __name__ == "__main__":
    main()
