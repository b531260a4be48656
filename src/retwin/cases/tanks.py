"""The cascaded tanks benchmark: a pump's voltage in, the level of the lower of two tanks out.

A real system with a hidden state, the upper tank's level, and physics that the simple twin lacks:
tanks run over. One record to estimate from and one to validate on, of 1024 samples at 4 s, both
from the same unknown state: M. Schoukens and J. P. Noël, "Three benchmarks addressing open
challenges in nonlinear system identification", IFAC-PapersOnLine 50 (2017).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.case import Case
from retwin.corrections import Additive
from retwin.errors import InputError
from retwin.networks import LSTM
from retwin.residual import SequenceMixture
from retwin.storage import sha256
from retwin.training import Training
from retwin.trajectories import Source, Trajectories
from retwin.twins.protocol import HEALTHY
from retwin.twins.tanks import INPUTS, OUTPUTS, RATE, TanksTwin, tanks_parametric

__all__ = ["TankSampler", "load_benchmark", "tanks", "tanks_overflow"]

ESTIMATION, VALIDATION = "estimation", "validation"

FITTED = TanksTwin()
OVERFLOWING = TanksTwin(
    overflow=True,
    pump=0.0577365,
    upper=0.0147705,
    lower=0.0888148,
    start_upper=17.91089,
    start_lower=5.22955,
    edge=23.88144,
    spill=0.752142,
    upper_power=0.814118,
    lower_power=0.352169,
)
"""All that is known of their physics; `identify` on the estimation record, see docs/tanks.md."""


@dataclass(frozen=True)
class TankSampler:
    """Voltages like the benchmark's: a multisine of random phases, most of it slow.

    Parameters
    ----------
    steps: samples per trajectory.
    period: samples of one period of the slowest sine.
    mean, deviation: of the voltage, in V.
    slow, fast: number of sines at full strength, and of all; frequencies are evenly spaced.
    weak: amplitude of the faster ones against the slow ones'.

    """

    steps: int = 320
    period: int = 1024
    mean: float = 2.8
    deviation: float = 1.0
    slow: int = 19
    fast: int = 59
    weak: float = 0.1

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Voltages (count, steps, 1); there are no movements, so `timing` does not matter."""
        amplitude = np.where(np.arange(1, self.fast + 1) <= self.slow, 1.0, self.weak)
        amplitude *= self.deviation * np.sqrt(2 / np.sum(amplitude**2))
        phase = rng.uniform(0, 2 * np.pi, size=(count, self.fast, 1))
        turns = np.arange(1, self.fast + 1)[:, None] * np.arange(self.steps) / self.period
        waves = amplitude[:, None] * np.cos(2 * np.pi * turns + phase)
        voltage = self.mean + waves.sum(axis=1)
        return voltage.clip(0.0, 10.0)[..., None].astype(np.float32)


def load_benchmark(path: str | Path, twin: TanksTwin = FITTED) -> tuple[Trajectories, Trajectories]:
    """The estimation record and the validation record of `dataBenchmark.csv`, one trajectory each.

    The columns that count are `uEst`, `yEst`, `uVal` and `yVal`; `nominal` is what the twin
    says. Raises InputError for a file that cannot be read or is another one.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            rows = list(csv.DictReader(lines))
        columns = {
            name: np.array([float(row[name]) for row in rows])
            for name in ("uEst", "yEst", "uVal", "yVal")
        }
    except (OSError, KeyError, ValueError, TypeError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            str(path),
            expected="dataBenchmark.csv, with numbers in columns uEst, yEst, uVal and yVal",
            got=f"{type(error).__name__}: {error}",
            remedy="take the file of the benchmark as it is",
        ) from None
    source = Source(path.name, sha256(path))
    return (
        _record(twin, columns["uEst"], columns["yEst"], ESTIMATION, source),
        _record(twin, columns["uVal"], columns["yVal"], VALIDATION, source),
    )


def _record(
    twin: TanksTwin, voltage: NDArray, level: NDArray, name: str, source: Source
) -> Trajectories:
    commands = voltage[None, :, None]
    return Trajectories(
        commands=commands,
        nominal=twin.simulate(commands, seed=0).nominal,
        observed=level[None, :, None],
        rate=RATE,
        labels=np.array([HEALTHY]),
        ids=np.array([name]),
        inputs=INPUTS,
        outputs=OUTPUTS,
        provenance=(source,),
    )


def tanks() -> Case:
    """The case; it has no faults, so nothing is diagnosed."""
    return Case(
        name="tanks",
        title="Cascaded tanks",
        faults={HEALTHY: None},
        twin=FITTED,
        emulator=None,
        sampler=TankSampler(),
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=RATE,
        parametric=tanks_parametric(overflow=True),
        network=LSTM(64),
        training=Training(epochs=120, batch=8, rate=5e-3),
        per_class=800,
        density=SequenceMixture(block=64, gap=32),
        records=load_benchmark,
    )


def tanks_overflow() -> Case:
    """The same with a twin that knows of overflow and of the outlets' powers."""
    return replace(
        tanks(),
        name="tanks_overflow",
        title="Cascaded tanks, their overflow known",
        twin=OVERFLOWING,
        records=partial(load_benchmark, twin=OVERFLOWING),
    )
