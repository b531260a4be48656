"""The cascaded tanks benchmark: from a pump's voltage to the level of the lower of two tanks.

A real system with a hidden state, the level of the upper tank, and with physics that the simple
twin lacks: the tanks overflow. The benchmark has one record for estimation and one for validation,
each of 1024 samples at 4 s and from the same unknown initial state.

References
----------
M. Schoukens and J. P. Noël, "Three benchmarks addressing open challenges in nonlinear system
identification", IFAC-PapersOnLine 50 (2017).

"""

from __future__ import annotations

from dataclasses import replace

from retwin.cases.cascaded_tanks.twin import RATE, TanksTwin, tanks_parametric
from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.data.trajectories import HEALTHY
from retwin.nets.networks import LSTM
from retwin.nets.training import Training
from retwin.twins.samplers import MultisineSampler
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture

__all__ = ["VOLTAGES", "benchmark", "tanks", "tanks_overflow"]

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
"""The complete physics, with parameters identified on the estimation record (docs/tanks.md)."""

PERIOD = 1024 / RATE
"""Period of the benchmark's voltage in s."""
VOLTAGES = MultisineSampler(
    (0.0,),
    (10.0,),
    RATE,
    320 / RATE,
    band=(1 / PERIOD, 59 / PERIOD),
    corner=19 / PERIOD,
    mean=(2.8,),
    deviation=(1.0,),
)
"""Voltages like the benchmark's, mostly slow; each trajectory is a third of a period."""


def benchmark(twin: TanksTwin) -> ColumnRecords:
    """Records of `dataBenchmark.csv`: estimation for calibration, validation for the test.

    Parameters
    ----------
    twin : TanksTwin
        The twin that gives the nominal output.

    Returns
    -------
    ColumnRecords
        A function from the file to both sets.

    """
    return ColumnRecords(twin, {"pump": "uEst", "level": "yEst"}, {"pump": "uVal", "level": "yVal"})


def tanks() -> Case:
    """The case with the simple twin; it has no faults, so nothing is diagnosed.

    Returns
    -------
    Case
        The case `tanks`.

    """
    return Case(
        name="tanks",
        title="Cascaded tanks",
        faults={HEALTHY: None},
        twin=FITTED,
        emulator=None,
        sampler=VOLTAGES,
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=RATE,
        parametric=tanks_parametric(overflow=True),
        network=LSTM(64),
        training=Training(max_epochs=120, batch_size=8, learning_rate=5e-3),
        per_class=800,
        density=SequenceMixture(block=64, margin=32),
        records=benchmark(FITTED),
    )


def tanks_overflow() -> Case:
    """The case whose twin includes overflow and the exponents of the outflows.

    Returns
    -------
    Case
        The case `tanks_overflow`.

    """
    return replace(
        tanks(),
        name="tanks_overflow",
        title="Cascaded tanks, their overflow known",
        twin=OVERFLOWING,
        records=benchmark(OVERFLOWING),
    )
