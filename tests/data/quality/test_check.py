"""Records that lie are named with record, channel and time; clean ones are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import retwin as rt
from retwin.data import check_records, explained_shares, summarise

RATE, STEPS, N = 20.0, 400, 6
Arrays = dict[str, np.ndarray]


def clean(seed: int = 0, noise: float = 0.02, *, nominal: bool = True) -> rt.Trajectories:
    """Two first-order lags that follow steps of two commands, with noise at rest."""
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-1, 1, (N, STEPS // 40, 2)).repeat(40, axis=1)
    outputs = np.zeros(commands.shape)
    for t in range(1, STEPS):
        outputs[:, t] = outputs[:, t - 1] + 0.15 * (commands[:, t - 1] - outputs[:, t - 1])
    observed = 1.1 * outputs + noise * rng.normal(size=outputs.shape)
    return rt.Trajectories(commands, nominal * outputs, observed, RATE)


def told(lie: Callable[[np.ndarray], None], **options: bool) -> rt.Trajectories:
    """The same with outputs (n, T, 2) that `lie` changes in place."""
    records = clean(**options)
    observed = np.array(records.observed)
    lie(observed)
    return records.replace(observed=observed)


def freeze(y: np.ndarray) -> None:
    y[2, 150:, 0] = y[2, 150, 0]


def clip(y: np.ndarray) -> None:
    y[2, :, 0] = y[2, :, 0].clip(max=0.4 * y[2, :, 0].max())


def drop(y: np.ndarray) -> None:
    y[2, 37::50, 0] = 0.0


def spike(y: np.ndarray) -> None:
    y[2, 200, 0] += 50.0


def whiten(y: np.ndarray) -> None:
    y[2, :, 0] = np.random.default_rng(1).normal(size=STEPS)


def rescale(y: np.ndarray) -> None:
    y[2] *= 1000.0


def copy(y: np.ndarray) -> None:
    y[2] = y[0] + 1e-6 * np.random.default_rng(1).normal(size=y[0].shape)


def copy_later(y: np.ndarray) -> None:
    y[2, 1:] = y[0, :-1]


SENSOR = [
    (freeze, "frozen", "y1"),
    (clip, "limit", "y1"),
    (drop, "dropouts", "y1"),
    (spike, "spikes", "y1"),
    (whiten, "noise", "y1"),
    (rescale, "unit", "y1"),
    (copy, "copy", ""),
    (copy_later, "copy", ""),
]


@pytest.mark.parametrize(("lie", "kind", "channel"), SENSOR)
@pytest.mark.parametrize("nominal", [True, False])
def test_a_lie_is_named(lie: Callable, kind: str, channel: str, *, nominal: bool) -> None:
    findings = check_records(told(lie, nominal=nominal)).findings
    assert ("00002", channel, kind) in {(f.record, f.channel, f.kind) for f in findings}
    assert {each.record for each in findings} == {"00002"}


def test_when_it_froze() -> None:
    (found,) = check_records(told(freeze)).findings
    assert (found.start, found.end) == (150 / RATE, STEPS / RATE)
    assert "y1 in 00002, 7.5 to 20 s, frozen" in summarise([found])[0]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
def test_clean_records_have_no_finding(seed: int, noise: float, *, nominal: bool) -> None:
    assert check_records(clean(seed, noise, nominal=nominal)).findings == ()


def test_rest_and_quantisation_are_no_fault() -> None:
    records = clean(nominal=False)
    rounded = np.round(records.observed / 0.2) * 0.2
    assert check_records(records.replace(observed=rounded)).findings == ()


def test_repeats_of_one_program_are_no_copies() -> None:
    one, other = (clean(noise=0.001) for _ in range(2))
    noise = 0.001 * np.random.default_rng(9).normal(size=other.observed.shape)
    both = rt.Trajectories.concatenate([one, other.replace(observed=1.1 * other.nominal + noise)])
    assert not [each for each in check_records(both).findings if each.kind == "copy"]


def exchange_records(y: np.ndarray) -> None:
    y[[1, 2]] = y[[2, 1]]


def exchange_outputs(y: np.ndarray) -> None:
    y[:] = y[..., ::-1].copy()


def hurry(y: np.ndarray) -> None:
    time = np.arange(STEPS)
    y[2] = np.stack([np.interp(1.1 * time, time, own) for own in y[2].T], axis=1)


def negate(y: np.ndarray) -> None:
    y[..., 0] *= -1


def rest(y: np.ndarray) -> None:
    y[:2] = 0.02 * np.random.default_rng(1).normal(size=y[:2].shape)


@pytest.mark.parametrize(
    ("lie", "kind", "records"),
    [
        (exchange_records, "other commands", {"00001", "00002"}),
        (exchange_outputs, "exchanged", {""}),
        (hurry, "time base", {"00002"}),
        (negate, "sign", {""}),
        (rest, "noise", {"00000", "00001"}),
    ],
)
def test_what_nominal_outputs_show(lie: Callable, kind: str, records: set[str]) -> None:
    found = {each.record for each in check_records(told(lie)).findings if each.kind == kind}
    assert found == records


def test_share_of_the_variance() -> None:
    records = clean().replace(labels=["Healthy"] * 4 + ["Stuck"] * 2)
    observed = np.array(records.observed)
    observed[4:] = 0.0
    shares = explained_shares(records.replace(observed=observed))
    assert shares["healthy"]["y1"] > 0.95
    assert shares["faulty"]["y1"] != shares["faulty"]["y1"]  # it never changes there
    assert "95" in " ".join(check_records(records).sentences) or shares["healthy"]["y2"] > 0.95


def test_outputs_that_never_change_have_no_share() -> None:
    """Nor does one that was never measured: JSON has no NaN, and numpy would warn of it."""
    observed = np.array(clean().observed)
    observed[..., 0], observed[..., 1] = 7.0, np.nan
    found = check_records(clean().replace(observed=observed, mask=None))
    assert found.values["explained"] == {"healthy": {}}
    assert found.sentences == []
    assert [each.channel for each in found.findings if each.kind == "never changes"] == ["y1"]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_outputs_whose_variance_overflows_are_read() -> None:
    x = np.random.default_rng(0).normal(size=(3, 50, 1))
    records = rt.Trajectories(commands=x, nominal=x, observed=1e200 * x, rate=10.0)
    assert check_records(records).findings == ()
