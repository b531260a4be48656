"""Where data came from, and how the channels of a log came to their samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Sampling:
    """How a channel came from a signal of a log.

    Parameters
    ----------
    channel : str
        The name of the channel.
    signal : str
        The name of the signal in the log.
    method : str
        `hold`, `linear` or `none`.
    rate : float
        The median rate of the signal in Hz, 0 if it has less than two values.
    missing : float
        The share of the samples in all trajectories, without their padding, that are missing.
    bridged : float
        The longest interval between values in s that was bridged.
    longest : float
        The longest interval between two values of the signal, in s.
    note : str
        What else was done to it.

    """

    channel: str
    signal: str
    method: str
    rate: float
    missing: float
    bridged: float
    longest: float
    note: str = ""


@dataclass(frozen=True)
class Provenance:
    """Where data came from.

    Parameters
    ----------
    name : str
        The name of a file, or of the class that simulated them, with its seed.
    sha256 : str
        The SHA-256 of the file, in hexadecimal; "" without a file.
    sampling : tuple of Sampling
        How each channel of a log came to its samples; empty for other files.
    notes : tuple of str
        What else was done to a log.

    """

    name: str
    sha256: str = ""
    sampling: tuple[Sampling, ...] = ()
    notes: tuple[str, ...] = ()

    def plain(self) -> dict[str, Any]:
        """The same as JSON values; what other files have none of is left out."""
        extra = {"sampling": [asdict(each) for each in self.sampling], "notes": list(self.notes)}
        kept = {key: value for key, value in extra.items() if value}
        return {"name": self.name, "sha256": self.sha256, **kept}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Provenance:
        """What `plain` gave."""
        from pydantic import TypeAdapter  # which only files need

        return TypeAdapter(cls).validate_python(values)
