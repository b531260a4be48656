"""How many steps of a simulator make up one sample, and how many samples a duration."""

from __future__ import annotations

from math import inf

import numpy as np

from retwin.checks import positive, require
from retwin.serialisation.sizes import Budget
from retwin.times import sample_rate, to_samples

TOLERANCE = 1e-5
"""Largest relative deviation of the steps from a whole number per sample, which covers steps that
are written as rounded decimals."""


def steps_per_sample(rate: float, step: float) -> int:
    """Number of simulator steps in a sample period.

    Parameters
    ----------
    rate : float
        Sample rate in Hz, above 0.
    step : float
        Step of the simulator in s, above 0.

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    InputError
        A rate or step that is not positive, or a step that does not divide the sample period.

    """
    sample_rate("rate", rate)
    positive("step", step, unit="s")
    ratio = 1.0 / rate / step
    count = round(ratio) if ratio < inf else 0
    fits = count >= 1 and abs(count * step * rate - 1.0) <= TOLERANCE
    expected = f"a step that divides the sample period, {1.0 / rate:g} s"
    remedy = f"give for instance step={1.0 / (rate * max(count, 1)):g}, or another sample rate "
    remedy += f"(--rate), {1.0 / (step * max(count, 1)):g} Hz"
    require(fits, "step", expected=expected, got=f"{step:g} s", remedy=remedy)
    return count


class Timed:
    """What has a sample rate in Hz and a duration in s, which are fields of the subclass."""

    rate: float
    duration: float

    @property
    def steps(self) -> int:
        """Samples per trajectory."""
        return to_samples(self.duration, self.rate)

    def check_steps(self) -> None:
        """Raise InputError for a rate without sense, and for too few samples or too many."""
        sample_rate("rate", self.rate)
        fits = 0 < self.duration < inf and self.steps >= 2
        expected = f"at least two samples, {2 / self.rate:g} s"
        remedy = "give the duration of a trajectory in seconds"
        require(fits, "duration", expected=expected, got=f"{self.duration!r} s", remedy=remedy)
        Budget("duration").take(self.steps * np.dtype(float).itemsize)
