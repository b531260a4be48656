"""Sample rates, and times: users give and read seconds and Hz, samples are internal only."""

from __future__ import annotations

from math import inf
from typing import Any

from retwin.checks import positive, require

LOWEST_RATE, HIGHEST_RATE = 1e-9, 1e12
"""Limits of sample rates in Hz: a sample in thirty years, and one per picosecond. Durations, and
squares of frequencies, are then finite in single precision."""

MAX_SAMPLES = 2**53
"""Largest number of samples: of larger ones a floating-point number does not hold each."""


def sample_rate(argument: str, value: Any, *, remedy: str = "") -> float:
    """`value`, if it is a sample rate in Hz within the limits.

    Raises
    ------
    InputError
        It is no positive finite number, or out of the limits.

    """
    rate = positive(argument, value, unit="Hz", remedy=remedy)
    require(
        LOWEST_RATE <= rate <= HIGHEST_RATE,
        argument,
        expected=f"a sample rate from {LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz",
        got=f"{rate:g} Hz",
        remedy=remedy or "check its unit, and the times from which it was computed",
    )
    return rate


def to_samples(seconds: float, rate: float) -> int:
    """The number of samples, at `rate` in Hz, that is nearest to a time in seconds.

    No more than an index can be, since a time so long is after the end of any trajectory.
    """
    return round(min(max(seconds * rate, -MAX_SAMPLES), MAX_SAMPLES))


def stride_of(
    rate: float,
    lower: float | None,
    *,
    steps: int | None = None,
    argument: str = "rate",
    remedy: str = "choose the rate of the data divided by a whole number",
) -> int:
    """Samples at one rate per sample at a lower one.

    Parameters
    ----------
    rate : float
        Sample rate of the data in Hz, above 0.
    lower : float or None
        Another rate in Hz, the rate of the data divided by a whole number; None is that of the
        data.
    steps : int, optional
        Samples of the data, of which at least two must remain.
    argument, remedy : str
        For the message.

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    InputError
        The lower rate does not divide the rate of the data, or leaves too few samples.

    """
    ratio = 1.0 if lower is None else rate / lower if lower > 0 else 0.0
    require(
        0.5 < ratio < inf and abs(ratio - round(ratio)) <= 1e-6,
        argument,
        expected=f"{rate:g} Hz, the data's rate, or a whole part of it",
        got=f"{lower} Hz",
        remedy=remedy,
    )
    stride = round(ratio)
    require(
        steps is None or stride < steps,
        argument,
        expected=f"at least two of the {steps} samples of a trajectory at {rate:g} Hz",
        got=f"{lower} Hz, which leaves one",
        remedy="give a higher rate, or longer trajectories",
    )
    return stride
