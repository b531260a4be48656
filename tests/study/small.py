"""A small study of the emulated robot; as a script, `python small.py OUT` runs it to its end."""

from __future__ import annotations

import sys
from dataclasses import replace

import retwin as rt
from retwin.nets.training import Training

PLAN = rt.StudyPlan(runs=2, per_class=10, folds=2, seed=3, simulated=4, overlaid=4)
BRISK = Training(max_epochs=6, batch_size=256, learning_rate=1e-2)
"""A surrogate that is good to a millimetre, in a second; the default one has a test of its own."""


def small_case() -> rt.Case:
    """The arm with networks that are trained briefly."""
    return replace(rt.cases.armpi(), network=rt.MLP((64, 64)), training=BRISK)


if __name__ == "__main__":
    rt.run_study(small_case(), PLAN, rt.StudyData(), sys.argv[1], processes=2)
