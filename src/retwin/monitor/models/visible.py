"""What is seen of a fault."""

from __future__ import annotations

from dataclasses import dataclass

SHARE = 0.9
"""Share of onsets after which a fault must have raised an alarm."""


@dataclass(frozen=True)
class Visible:
    """What is seen of a fault.

    Attributes
    ----------
    fault : str
        Its name.
    size : float or None
        The smallest size of those tried that is seen, and all larger ones are; None where none is,
        or where the fault has no size.
    largest : float or None
        The largest size that was tried; None where the fault has no size.
    share : float
        Share of onsets with an alarm in time: at `size`, or else at the largest one.
    within : float
        That time in s.
    unit : str
        Of the sizes; "" where there are none.
    value : float or None
        What is changed by a size as large as itself: a parameter, or 1 for a command; None where a
        size is compared with nothing.

    """

    fault: str
    size: float | None
    largest: float | None
    share: float
    within: float
    unit: str = ""
    value: float | None = None

    @property
    def hidden(self) -> bool:
        """Whether it is not seen, or only where it is as large as what it changes."""
        if self.value is None or self.size is None:
            return self.share < SHARE
        return self.share < SHARE or abs(self.size) >= abs(self.value)

    @property
    def shown_size(self) -> str:
        """The size from which on it is seen, with its unit and as a share of what it changes."""
        of = f" {self.unit}" if self.unit not in ("", "1") else ""
        text = f"{abs(self.size or 0.0):.3g}{of}"
        if self.size is not None and self.value and self.value != 1:
            text += f", {abs(self.size / self.value):.0%} of the value"
        return text

    def __str__(self) -> str:
        """One line for the terminal."""
        of = f" {self.unit}" if self.unit not in ("", "1") else ""
        if self.share < SHARE:
            what = (
                "not seen"
                if self.largest is None
                else f"not seen up to {abs(self.largest):.3g}{of}"
            )
        else:
            what = "seen" if self.size is None else f"seen from a size of {self.shown_size}"
        return f"{self.fault}: {what} ({self.share:.0%} within {self.within:.3g} s)"
