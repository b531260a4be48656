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

from retwin.cases.cascaded_tanks.twin import OVERFLOWING_TANKS, RATE, TANKS
from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.nets.networks import LSTM
from retwin.nets.training import Training
from retwin.twins.commands.samplers import MultisineSampler
from retwin.twins.twin import Twin
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture

OVERFLOWING = OVERFLOWING_TANKS.parametric().with_values(
    {
        "pump": 0.0648524,
        "upper": 0.00648950,
        "lower": 0.100076,
        "edge": 33.97667,
        "spill": 0.702221,
        "upper_power": 1.0,
        "lower_power": 0.350039,
        "start_upper": 26.79919,
        "start_lower": 5.232571,
    }
)
"""The complete physics; its parameters are identified on the estimation record.

See benchmarks/results/tanks.md.
"""

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


def benchmark(twin: Twin) -> ColumnRecords:
    """Records of `dataBenchmark.csv`: estimation for calibration, validation for the test.

    Parameters
    ----------
    twin : Twin
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
        twin=TANKS,
        sampler=VOLTAGES,
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=RATE,
        parametric=OVERFLOWING_TANKS.parametric(),
        network=LSTM(64),
        training=Training(max_epochs=120, batch_size=8, learning_rate=5e-3),
        per_class=800,
        density=SequenceMixture(block=64, margin=32),
        records=benchmark(TANKS),
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
