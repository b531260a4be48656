"""False alarms in words, rates and samples, and the sentence of the promise."""

from __future__ import annotations

import pytest

from retwin.errors import InputError
from retwin.monitor import Promise, Slack, false_alarms


@pytest.mark.parametrize(
    ("wanted", "rate", "samples"),
    [
        ("1 per day", 10.0, 864000.0),
        ("1 per month", 1 / 3, 876600.0),
        ("2 per year", 1.0, 15778800.0),
        ("0.5 an hour", 1.0, 7200.0),
        ("1e-3 Hz", 10.0, 10000.0),
        ("1000 samples", 10.0, 1000.0),
        (1000, 10.0, 1000.0),
        ("  3  PER  weeks ", 1.0, 201600.0),
    ],
)
def test_words_rates_and_samples(wanted: str | float, rate: float, samples: float) -> None:
    assert false_alarms(wanted, rate) == pytest.approx(samples)


WRONG = ("", "1 per fortnight", "never", "-1 per day", "0 per day", "0 Hz", "nan samples")
OUTSIDE = (0.001, 9, float("nan"), float("inf"), "1e-300 per year", "1e999 per day", 1e16)


@pytest.mark.parametrize("wanted", [*WRONG, *OUTSIDE, True, None])
def test_what_is_no_promise_is_refused_with_a_remedy(wanted: object) -> None:
    with pytest.raises(InputError, match=r"false_alarms: expected .*, got .*; write '1 per month'"):
        false_alarms(wanted, 10.0)  # type: ignore[arg-type]


def test_the_rate_is_checked() -> None:
    with pytest.raises(InputError, match="rate: expected"):
        false_alarms("1 per day", 0.0)


def test_the_promise_states_class_rate_and_level() -> None:
    text = str(Promise(864000.0, 1.0, Slack(1.25, 0.1), alpha=0.05))
    for part in (
        "864000 measured samples",
        "10 days",
        "1.25 times as large",
        "0.1 standard",
        "0.05",
    ):
        assert part in text
