"""The correction of a residual model's file: before version 0.1.0 its times were in samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from retwin.catalog import CORRECTIONS, classes
from retwin.errors import InputError
from retwin.serialisation.configs import Converted, from_config, to_config
from retwin.update.corrections import Correction

TIMES = ("delay_range", "known_delay", "phases")
"""Settings that were in samples under the names that they have now."""


def written_correction(correction: Correction) -> dict[str, Any]:
    """The part of a model's description that `read_correction` reads."""
    return {"correction": to_config(correction, classes(CORRECTIONS)), "times": "s"}


def read_correction(about: Mapping[str, Any], rate: float | None) -> Correction:
    """The correction of a model's description.

    Parameters
    ----------
    about : mapping
        The description.
    rate : float, optional
        Sample rate in Hz, by which the times of a file from before version 0.1.0 are converted.

    Raises
    ------
    InputError
        Times are in samples, and there is no rate.

    """
    config = about["correction"]
    if about.get("times") == "s":
        rate = None
    else:
        config = _in_seconds(config, rate)
    return from_config(config, classes(CORRECTIONS), rate=rate)


def _in_seconds(config: Mapping[str, Any], rate: float | None) -> dict[str, Any]:
    """The settings of a correction and of those in it, times in seconds."""
    made = {}
    for name, value in config.items():
        made[name] = _in_seconds(value, rate) if isinstance(value, Mapping) else value
        if name in TIMES and value is not None:
            if rate is None:
                raise InputError(
                    "rate",
                    expected="the sample rate in Hz, since the file is from before version 0.1.0",
                    got=f"none, and {name} = {value} in samples",
                    remedy="give the rate, or load the corrected twin",
                )
            made[name] = Converted(name).of(value, rate)
    return made
