"""The Silverbox benchmark: a linear twin of a system with a cubic spring.

`SNLS80mV.csv` has the "arrow", noise of growing amplitude, whose last quarter lies beyond the
amplitudes of the estimation data, and ten realisations of a multisine, between which the input
rests. Realisations 1 to 9 calibrate; the arrow and realisation 10 test.
"""

from __future__ import annotations

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords, Record
from retwin.cases.silver_box.twin import SILVERBOX
from retwin.nets.networks import LSTM
from retwin.twins.commands.samplers import MultisineSampler
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture

COLUMNS = {"input": "V1", "output": "V2"}
TRANSIENT = 50 / SILVERBOX.rate
"""Duration in s at the begin of each record that the benchmark does not score."""
ARROW = (0, 40_500)
"""Rows of the arrow, which ends where the input comes to rest."""
REALISATIONS = tuple((40_540 + 8692 * i, 40_540 + 8692 * (i + 1)) for i in range(10))
"""Rows of each multisine, from the middle of one rest to that of the next."""


def silverbox() -> Case:
    """The case with the linear twin; it has no faults, so nothing is diagnosed.

    Returns
    -------
    Case
        The case `silverbox`.

    """
    records = [Record(COLUMNS, rows, TRANSIENT) for rows in (*REALISATIONS, ARROW)]
    return Case(
        name="silverbox",
        title="Silverbox",
        twin=SILVERBOX,
        sampler=MultisineSampler(
            (-0.2,), (0.2,), SILVERBOX.rate, 1024 / SILVERBOX.rate, (1.0, 200.0), deviation=(0.05,)
        ),
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=SILVERBOX.rate,
        parametric=SILVERBOX.parametric(),
        network=LSTM(64),
        density=SequenceMixture(block=256, margin=64),
        records=ColumnRecords(SILVERBOX, records[:9], records[9:]),
    )
