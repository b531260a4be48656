"""Time of fitting, and error of each surrogate.

Targets: the RG on 54 trajectories in at most 20 s; RMSE on held-out twin trajectories at most
0.3 mm per axis for the MLP and 2 mm for the LSTM.
"""

from __future__ import annotations

import sys
import time

from record import record

import retwin as rt
from retwin.nets.networks import Network


def main(networks: list[str]) -> None:
    case = rt.cases.armpi()
    twin = rt.generate(case.twin, case, per_class=400, seed=0)
    real = rt.generate(case.emulator, case, per_class=6, seed=1)
    rows: dict[str, float] = {}
    configs: dict[str, Network] = {"mlp": rt.MLP(), "lstm": rt.LSTM(), "tcn": rt.TCN()}
    fitted = {}
    for name in networks:
        started = time.perf_counter()
        fitted[name] = rt.fit_surrogate(twin, configs[name], seed=0)
        rows[f"{name}: fit (s)"] = time.perf_counter() - started
        for axis in "xyz":
            rows[f"{name}: RMSE {axis} (mm)"] = 1e3 * fitted[name].fitted.figures[f"rmse_{axis}"]
    ibg = next(iter(fitted.values()))
    for which in ("healthy", "all"):
        started = time.perf_counter()
        rt.fit_residual(ibg, real, seed=0, calibrate_on=which)
        rows[f"RG on {which} of 54 trajectories (s)"] = time.perf_counter() - started
    record("fitting", "fitting, 3600 twin trajectories", rows)


if __name__ == "__main__":
    main(sys.argv[1:] or ["mlp", "lstm", "tcn"])
