"""The filter of running systems, sample by sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.twins.compiled import steps
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics
from retwin.update.dynamics.filter import online
from retwin.update.dynamics.filter.online import FilterState, OnlineFilter

TWIN = StateTwin(
    (State("x", "m", 0.0, -1.0, 1.0), State("v", "m/s")),
    lambda x, u: x.x,
    rt.Channels(("u",), ("N",)),
    rt.Channels(("y",), ("m",)),
    20.0,
    derivative=lambda x, u, p: (x.v, u.u - p.k * x.x - x.v),
    parameters=(Parameter("k", "1/s2", 0.1, 50.0, 4.0),),
)
COMMANDS = np.cumsum(np.random.default_rng(0).normal(size=(3, 80, 1)), axis=1) / 5


def fitted(interpolation: str) -> DynamicsTwin:
    twin = replace(TWIN, interpolation=interpolation)
    made = twin.simulate(COMMANDS, seed=0, parameters={"k": 5.0})
    noise = 1e-2 * np.random.default_rng(1).normal(size=made.observed.shape)
    settings = Dynamics(Library(0, (), False))
    return fit_dynamics(twin, made.replace(observed=made.observed + noise), settings).twin


@pytest.fixture(
    scope="module",
    params=["linear", *(pytest.param(each, marks=pytest.mark.slow) for each in ("hold", "spline"))],
)
def twin(request: pytest.FixtureRequest) -> DynamicsTwin:
    return fitted(request.param)


def stream(count: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    measured = rng.normal(size=(count, 60, 1)) / 10
    seen = rng.random((count, 60, 1)) > 0.2
    return COMMANDS[:count, :60], np.where(seen, measured, np.nan), seen


def passed(running: OnlineFilter, cuts: list[int]) -> list[np.ndarray]:
    state, found = running.start(3), []
    for part in zip(*(np.split(each, cuts, axis=1) for each in stream()), strict=True):
        state, *more = running.step(state, *part)
        found.append(more)
    return [np.concatenate(each, axis=1) for each in zip(*found, strict=True)] + [state.states]


def test_however_samples_are_cut_the_results_are_the_same_bytes(twin: DynamicsTwin) -> None:
    whole, *others = (
        [each.tobytes() for each in passed(OnlineFilter(twin), cuts)]
        for cuts in ([], [7, 8, 30], list(range(1, 60)))
    )
    assert all(each == whole for each in others)


def test_it_is_the_filter_of_whole_records() -> None:
    twin = fitted("linear")
    commands, measured, seen = stream()
    mean, covariance, _ = twin.filter(
        commands, np.where(seen, measured, 0.0), seen, known_start=False
    )
    found = passed(OnlineFilter(twin), [20])
    # One sample of propagation lies between the two starts.
    np.testing.assert_allclose(found[0][:, 40:], mean[:, 40:], atol=1e-4)
    np.testing.assert_allclose(found[1][:, 40:], covariance[:, 40:], rtol=1e-3)


def test_each_system_is_by_itself(twin: DynamicsTwin) -> None:
    online = OnlineFilter(twin)
    commands, measured, seen = stream()
    state, mean, _ = online.step(online.start(3), commands, measured, seen)
    rows = np.array([2, 0])
    own, few, _ = online.step(online.start(2), commands[rows], measured[rows], seen[rows])
    np.testing.assert_array_equal(few, mean[rows])
    again = online.start(3).merged(rows, own).of(rows)
    assert isinstance(again, FilterState)
    np.testing.assert_array_equal(again.states, state.states[rows])


def test_it_is_the_same_without_a_compiler(
    twin: DynamicsTwin, monkeypatch: pytest.MonkeyPatch
) -> None:
    cuts = [5, 6]
    compiled = passed(OnlineFilter(twin), cuts)
    monkeypatch.setattr(steps, "compiled", lambda source: None)
    for one, other in zip(compiled, passed(OnlineFilter(twin), cuts), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-11)


def test_the_main_directions_have_most_of_the_effect_on_outputs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    twin = fitted("linear")
    assert online.with_main_directions(twin, COMMANDS) is twin
    count = len(twin.filter.directions(known_start=False))
    weak = np.zeros((len(twin.values), 1))
    weak[0] = 1e-4 * np.abs(twin.factor[0]).max()
    more = replace(twin, factor=np.concatenate([weak, twin.factor], axis=1))
    monkeypatch.setattr(online, "MAX_DIRECTIONS", count)
    main = online.with_main_directions(more, COMMANDS).filter.directions(known_start=False)
    own = twin.filter.directions(known_start=False)
    assert len(main) == count < len(more.filter.directions(known_start=False))
    np.testing.assert_allclose(main.T @ main, own.T @ own, rtol=1e-3, atol=1e-9)
