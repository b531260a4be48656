"""Conversion of times: users give and read seconds and Hz, samples are used internally only."""

from __future__ import annotations

from retwin.checks import require

__all__ = ["stride_of", "to_samples"]


def to_samples(seconds: float, rate: float) -> int:
    """The number of samples, at `rate` in Hz, that is nearest to a time in seconds."""
    return round(seconds * rate)


def stride_of(
    rate: float,
    lower: float | None,
    *,
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
    argument, remedy : str
        For the message.

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    InputError
        The lower rate does not divide the rate of the data.

    """
    ratio = 1.0 if lower is None else rate / lower if lower > 0 else 0.0
    require(
        ratio > 0.5 and abs(ratio - round(ratio)) <= 1e-6,
        argument,
        expected=f"{rate:g} Hz, the data's rate, or a whole part of it",
        got=f"{lower} Hz",
        remedy=remedy,
    )
    return round(ratio)
