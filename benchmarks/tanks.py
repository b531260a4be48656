"""Simulation error of each source on the cascaded tanks. All models are fitted to one record.

    python benchmarks/tanks.py DATA.csv [--base plain|overflow] [--final]
    python benchmarks/tanks.py DATA.csv --physics

The protocol is that of the benchmark: fit to the estimation record, simulate the validation record
from the system's initial state, which both records share; no measured level of the validation
record is used. `base` is the twin that the surrogate approximates and the residual model corrects:
the simple one, or the one with overflow and free exponents of the outflows. `twin` is fitted by its
parameters alone (Eq. 2, so it is `pi_ls` too): the simple one by least squares, the other with the
robust loss of `identify`. `ibg` is its surrogate, `mean_corrected` the surrogate plus the mean of
the RG, `ibg_rg` the mean of samples.

Without `--final` only the estimation record is used: the figures of the RG are those of held-out
blocks with a margin. Choices were made on these, two of them after a first score on the validation
record (docs/tanks.md). With `--final` the validation record is scored: RMSE in V; the share of
measured points within the 5 and 95 % quantiles of 500 samples, with its 95 % interval from a
circular block bootstrap over time; and CRPS in V.

With `--physics` three sets of equations are compared on the estimation record: fitted to all of it,
and to all but a block of 128 samples and 16 on either side, which is then simulated; by linear
least squares.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import scoringrules
import torch
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.cases.cascaded_tanks.case import VOLTAGES, benchmark, tanks
from retwin.cases.cascaded_tanks.twin import OVERFLOWING_TANKS, TANKS
from retwin.update.corrected import CorrectedTwin
from retwin.update.identification import LeastSquares, identify

DRAWS = 500
BLOCK = 64
"""Length of a block in samples: errors of the twin are hardly correlated beyond it."""
HELD_OUT, MARGIN = 128, 16
"""Length in samples of a block that is held out for `--physics`, and of what is left out beside it
on either side."""
SIMULATED = 800
"""Simulations from which the surrogate learns."""


def scored(values: NDArray, measured: NDArray) -> dict[str, float]:
    """Scores of simulations (draws, T) of a measured level (T,); one draw if deterministic."""
    error = values.mean(axis=0) - measured
    made = {"rmse": float(np.sqrt(np.mean(error**2)))}
    made["crps"] = float(scoringrules.crps_ensemble(measured, values, m_axis=0).mean())
    if len(values) == 1:
        return made | dict.fromkeys(("coverage90", "from", "to"), np.nan)
    low, high = np.quantile(values, [0.05, 0.95], axis=0, method="weibull")
    inside = (low <= measured) & (measured <= high)
    begins = np.random.default_rng(0).integers(len(inside), size=(2000, -(-len(inside) // BLOCK)))
    drawn = inside[(begins[..., None] + np.arange(BLOCK)) % len(inside)].mean(axis=(1, 2))
    ends = np.quantile(drawn, [0.025, 0.975])
    return made | dict(zip(("coverage90", "from", "to"), [inside.mean(), *ends], strict=True))


def fitted(estimation: rt.Trajectories, base: str) -> tuple[rt.Twin, CorrectedTwin, dict]:
    """The identified twin, the corrected one, and their figures on the estimation record."""
    case = tanks()
    figures: dict[str, float] = {}
    began = time.perf_counter()
    twin: rt.Twin = case.twin
    if base == "overflow":
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="not identified")
            free = OVERFLOWING_TANKS.parametric()
            found = identify(free, estimation, seed=0, method=LeastSquares(starts=2))
        twin = found.twin
        print(found.values)
    figures["twin: s"] = time.perf_counter() - began
    simulated = twin.simulate(estimation.commands, seed=0).observed
    figures["twin: rmse, V"] = float(np.sqrt(np.mean((simulated - estimation.observed) ** 2)))
    began = time.perf_counter()
    rng = np.random.default_rng(1)
    made = twin.simulate(case.sampler.sample(SIMULATED, rng=rng), seed=0)
    ibg = rt.fit_surrogate(made, case.network, seed=0, training=case.training)
    figures["surrogate: s"] = time.perf_counter() - began
    whole = replace(VOLTAGES, steps=estimation.steps)
    fresh = twin.simulate(whole.sample(50, rng=np.random.default_rng(99)), seed=0)
    error = np.square(ibg.predict(fresh.commands) - fresh.nominal)
    for name, part in (
        ("", slice(None)),
        (" first quarter", slice(256)),
        (" last quarter", slice(-256, None)),
    ):
        figures[f"surrogate: nrmse{name}"] = float(
            np.sqrt(error[:, part].mean()) / fresh.nominal.std()
        )
    began = time.perf_counter()
    rg = rt.fit_residual(ibg, estimation, case.correction, case.density, seed=0)
    figures["residual: s"] = time.perf_counter() - began
    figures |= {f"residual, held out: {name}": value for name, value in rg.fitted.figures.items()}
    print(rg.fitted.reason)
    return twin, CorrectedTwin(ibg, rg, "tanks"), figures


def physics(estimation: rt.Trajectories) -> dict[str, dict[str, float]]:
    """RMSE in V of each set of equations, on the whole record and on blocks that are held out."""
    every = OVERFLOWING_TANKS.parametric()
    models = {
        "simple": TANKS.parametric(),
        "with overflow": every.holding("upper_power", "lower_power"),
        "with overflow and powers": every,
    }
    rows, method = {}, LeastSquares(starts=2, loss="linear")
    for name, free in models.items():
        whole = identify(free, estimation, seed=0, method=method)
        squares = []
        for first in range(0, estimation.steps, HELD_OUT):
            seen = estimation.mask.copy()
            seen[:, max(0, first - MARGIN) : first + HELD_OUT + MARGIN] = False
            found = identify(free, estimation.replace(mask=seen), seed=0, method=method)
            error = found.twin.simulate(estimation.commands, seed=0).observed - estimation.observed
            squares.append(float(np.mean(error[:, first : first + HELD_OUT] ** 2)))
        rows[name] = {
            "parameters": float(len(free.names)),
            "whole record, V": whole.figures["rms_after"],
            "held out, V": float(np.sqrt(np.mean(squares))),
            "without the first block, V": float(np.sqrt(np.mean(squares[1:]))),
        }
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("--base", choices=["plain", "overflow"], default="plain")
    parser.add_argument("--final", action="store_true")
    parser.add_argument("--physics", action="store_true")
    parser.add_argument("--model", type=Path, help="folder in which the corrected twin is saved")
    options = parser.parse_args()
    torch.set_num_threads(1)
    estimation, validation = benchmark(tanks().twin)(options.file)
    if options.physics:
        warnings.filterwarnings("ignore", message="not identified")
        record("tanks_physics", "Estimation record", physics(estimation))
        return
    twin, updated, figures = fitted(estimation, options.base)
    record(f"tanks_{options.base}_estimation", "Estimation record", figures)
    if options.model:
        updated.save(options.model)
    if not options.final:
        return
    commands, level = validation.commands, validation.observed[0, :, 0]
    many = np.repeat(commands, DRAWS, axis=0)
    rows = {
        "twin": twin.simulate(commands, seed=0),
        "ibg": updated.surrogate.simulate(commands, seed=0),
        "mean_corrected": replace(updated, random=False).simulate(commands, seed=0),
        "ibg_rg": updated.simulate(many, seed=0),
    }
    record(
        f"tanks_{options.base}",
        f"Validation record, base {options.base}",
        {name: scored(made.observed[..., 0].astype(float), level) for name, made in rows.items()},
    )


if __name__ == "__main__":
    main()
