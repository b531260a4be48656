"""How often a monitor may raise a false alarm, and the sentence that states what is promised."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from retwin.checks import finite, given, positive, whole
from retwin.monitor.detect.slack import Slack
from retwin.times import sample_rate

SECONDS = {
    "second": 1.0,
    "minute": 60.0,
    "hour": 3600.0,
    "day": 86400.0,
    "week": 604800.0,
    "month": 2629800.0,
    "year": 31557600.0,
}
"""Seconds of each unit of time: a year has 365.25 days, and a month is its twelfth part."""
MIN_RUN_LENGTH, MAX_RUN_LENGTH = 10.0, 1e15
"""Limits of an average run length in samples: below ten samples every second alarm would be false
at common rates, and above 1e15 the sums of a detector no longer count single samples."""
SIGNIFICANCE = 0.05
"""Probability of the observed false alarms or more, below which the promise counts as broken."""
FORMS = re.compile(
    r"(?P<number>\d+(?:\.\d*)?(?:e[+-]?\d+)?) ?"
    rf"(?:(?:per|an?) (?P<unit>{'|'.join(SECONDS)})s?|hz|(?P<count>samples?|trajector(?:y|ies)))"
)
"""How a rate of false alarms, or a run length, may be written."""


def false_alarms(wanted: str | float, rate: float) -> float:
    """The average run length (ARL) to a false alarm, in samples.

    Parameters
    ----------
    wanted : str or float
        A number per unit of time ("1 per month", "2 per year", "0.5 per hour"), a rate ("1e-6 Hz"),
        a run length ("1000 samples", "1000 trajectories"), or the same as a number.
    rate : float
        Sample rate in Hz, or trajectories per second.

    Returns
    -------
    float
        From 10 to 1e15. It is the threshold of a `Detector`.

    Raises
    ------
    InputError
        The text has none of these forms, or the run length is outside the limits.

    Examples
    --------
    >>> false_alarms("1 per day", 10.0)
    864000.0

    """
    per_second = sample_rate("rate", rate)
    remedy = "write '1 per month', '2 per year', '1e-6 Hz' or '1000 samples'"
    samples: Any = wanted
    if isinstance(wanted, str):
        text = " ".join(wanted.lower().split())
        expected = f"a number per {', '.join(SECONDS)}, a rate in Hz, or a number of samples"
        form, got = FORMS.fullmatch(text), repr(wanted)
        found = given("false_alarms", form, expected, got=got, remedy=remedy)
        number = positive("false_alarms", float(found["number"]), remedy=remedy)
        time = SECONDS[found["unit"] or "second"] * per_second
        samples = number if found["count"] else time / number
    return finite(
        "false_alarms",
        samples,
        at_least=MIN_RUN_LENGTH,
        at_most=MAX_RUN_LENGTH,
        unit="samples from one false alarm to the next, on average",
        remedy=f"{remedy}; a bare number counts samples",
    )


@dataclass(frozen=True)
class FalseAlarmTest:
    """Alarms of a version on healthy samples, compared with the rate that was promised.

    Parameters
    ----------
    alarms : int
        Alarms that were raised.
    samples : int
        Healthy samples on which they were.
    run_length : float
        The promised mean number of samples between false alarms.
    unit : str
        What is counted: "samples", or "trajectories".

    """

    alarms: int
    samples: int
    run_length: float
    unit: str = "samples"

    def __post_init__(self) -> None:
        whole("alarms", self.alarms)
        whole("samples", self.samples, at_least=1)
        positive("run_length", self.run_length, unit=self.unit)

    @property
    def p(self) -> float:
        """The probability of so many alarms or more at the promised rate, by Poisson."""
        from scipy.stats import poisson

        return float(poisson.sf(self.alarms - 1, self.samples / self.run_length))

    @property
    def passed(self) -> bool:
        """Whether the alarms agree with the promise, which few samples cannot prove."""
        return self.p >= SIGNIFICANCE


@dataclass(frozen=True)
class Tried:
    """What happened on the records of the calibration, each watched by the others alone.

    Parameters
    ----------
    events, samples : dict of str to int
        Events and measured samples of each record, or of each part of a single one.

    """

    events: dict[str, int]
    samples: dict[str, int]

    @property
    def run_length(self) -> float:
        """Samples between events that are certain at 95 %, by the exact bound of Poisson's rate."""
        return shortest(sum(self.events.values()), sum(self.samples.values()))

    def kept(self, arl: float) -> bool:
        """Whether the events agree with an average run length."""
        events, samples = sum(self.events.values()), sum(self.samples.values())
        return FalseAlarmTest(events, samples, arl).passed

    def text(self, rate: float) -> str:
        """One sentence, for samples at a rate in Hz."""
        worst = max(self.events, key=lambda name: self.events[name])
        count, hours = sum(self.events.values()), sum(self.samples.values()) / rate / 3600
        text = (
            f"Of {len(self.events)} parts of the calibration, each left out in turn, {count} "
            f"events in {hours:.3g} h, which alone bounds their rate at one in "
            f"{duration(self.run_length / rate)} (exact 95 %)"
        )
        if count:
            text += f"; {self.events[worst]} of them in {worst}"
        return (
            f"{text}. The promise extends to no states, loads and days that these parts do not "
            "contain: calibrate with records that do."
        )


def shortest(events: int, samples: float) -> float:
    """The lower 95 % bound of the average samples per event, exact by Poisson (Garwood, 1936)."""
    from scipy.stats import chi2

    return float(samples / (chi2.ppf(0.95, 2 * (events + 1)) / 2))


@dataclass(frozen=True)
class Promise:
    """What a monitor guarantees, for which distributions, and how often it may be wrong.

    Parameters
    ----------
    arl : float
        Average run length to a false alarm in samples, of `false_alarms`.
    rate : float
        Sample rate in Hz.
    slack : Slack
        The class of distributions.
    alpha : float
        Probability that the monitor ever declares the promise void although it holds.
    slower : tuple of Slack
        The classes of the models that follow what is measured more slowly; see `Predictor`.

    """

    arl: float
    rate: float
    slack: Slack
    alpha: float = 0.01
    slower: tuple[Slack, ...] = ()

    def __str__(self) -> str:
        """One sentence for pages, logs and the terminal."""
        others = "".join(f" (of slower predictions {each})" for each in self.slower)
        return (
            f"On average at least {self.arl:.6g} measured samples "
            f"({duration(self.arl / self.rate)}) pass until a false alarm, "
            "as long as the errors of predictions are distributed as in the calibration, or at "
            f"most {self.slack}{others}. "
            f"Where that is so, it is declared void with a probability of at most {self.alpha:g}."
        )


def duration(seconds: float) -> str:
    """A duration in the largest unit but weeks of which it has at least one, or in seconds."""
    units = [each for each in reversed(SECONDS) if each != "week" and seconds >= SECONDS[each]]
    unit = units[0] if units else "second"
    count = f"{seconds / SECONDS[unit]:.3g}"
    return f"{count} {unit}" if count == "1" else f"{count} {unit}s"
