"""How many steps of a simulator make up one sample."""

from __future__ import annotations

from retwin.checks import positive, require

__all__ = ["steps_per_sample"]

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
    positive("rate", rate, unit="Hz")
    positive("step", step, unit="s")
    count = round(1.0 / (rate * step))
    require(
        count >= 1 and abs(count * step * rate - 1.0) <= TOLERANCE,
        "step",
        expected=f"a step that divides the sample period, {1.0 / rate:g} s",
        got=f"{step:g} s",
        remedy=f"give for instance step={1.0 / (rate * max(count, 1)):g}",
    )
    return count
