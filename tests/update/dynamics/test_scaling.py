"""Estimates from many trajectories, each with starts of its own."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update.dynamics import Dynamics, Library, fit_dynamics
from retwin.update.dynamics import estimation as module
from retwin.update.dynamics.arrow import Arrow, trust_region_step
from retwin.update.dynamics.estimation import Estimation
from retwin.update.dynamics.left_out import dependent_errors, errors_without, held_out
from retwin.update.dynamics.linearised import Linearised, Point
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of

POSITION = State("position", "m", 0.1, -1.0, 1.0)
VELOCITY = State("velocity", "m/s", 0.0, -2.0, 2.0)
OSCILLATOR = StateTwin(
    (POSITION, VELOCITY),
    lambda x, u: (x.position, x.velocity),
    rt.Channels(("force",), ("N",)),
    rt.Channels(("position", "velocity"), ("m", "m/s")),
    20.0,
    derivative=lambda x, u, p: (
        x.velocity,
        u.force - p.damping * x.velocity - p.spring * x.position,
    ),
    parameters=(Parameter("spring", "N/m", 1, 50, 12), Parameter("damping", "N s/m", 0.1, 5, 1.5)),
)


def estimation(count: int, samples: int) -> tuple[Estimation, Linearised]:
    """The estimation from a record of known parameters, and its start."""
    rng = np.random.default_rng(0)
    truth = {"spring": 9.0, "damping": 0.8}
    starts = {
        "start_position": rng.uniform(-0.5, 0.5, count),
        "start_velocity": rng.normal(size=count),
    }
    commands = np.cumsum(rng.normal(size=(count, samples, 1)), axis=1)
    made = OSCILLATOR.simulate(commands, seed=0, parameters=truth | starts)
    noisy = made.observed + 0.01 * rng.normal(size=made.observed.shape)
    record = made.replace(observed=noisy, mask=rng.random(noisy.shape) < 0.9)
    twin, free, values = state_twin_of(OSCILLATOR)
    unknowns = unknowns_of(twin, free, values)
    own = Estimation(twin, record, unknowns, record.mask, np.full(2, 1e-4))
    start = Point(unknowns.mean, np.tile(unknowns.start[unknowns.free], (count, 1)))
    return own, own.linearised(start)


def arrow(count: int = 5, k: int = 3, m: int = 2) -> tuple[Arrow, np.ndarray]:
    """A positive definite matrix of that shape, and the same written out."""
    rng = np.random.default_rng(0)
    size, parts = k + count * m, [rng.normal(size=(8, k + m)) for _ in range(count)]
    dense = np.zeros((size, size))
    for i, part in enumerate(parts):
        own = np.r_[0:k, k + i * m : k + (i + 1) * m]
        dense[np.ix_(own, own)] += part.T @ part
    grams = np.array([part.T @ part for part in parts])
    return Arrow(grams[:, :k, :k].sum(axis=0), grams[:, k:, :k], grams[:, k:, k:]), dense


@pytest.mark.parametrize(("k", "m"), [(3, 2), (3, 0), (0, 2)])
def test_an_arrow_is_the_matrix_written_out(k: int, m: int) -> None:
    made, dense = arrow(k=k, m=m)
    right, unit = np.arange(1.0, len(dense) + 1), np.linspace(0.5, 2, len(dense))
    np.testing.assert_allclose(made.solve(right), np.linalg.solve(dense, right))
    np.testing.assert_allclose(made.times(right), dense @ right)
    np.testing.assert_allclose(made.diagonal, np.diag(dense))
    changed = made.scaled(unit).plus(right)
    wanted = unit[:, None] * dense * unit + np.diag(right)
    np.testing.assert_allclose(changed.times(unit), wanted @ unit)
    inverse = np.linalg.inv(dense)[:k, :k]
    np.testing.assert_allclose(np.linalg.inv(made.reduced()[0]), inverse)


@pytest.mark.parametrize("radius", [1e3, 1.0, 1e-3])
def test_a_step_is_the_best_of_its_trust_region(radius: float) -> None:
    made, dense = arrow()
    gradient = np.arange(1.0, len(dense) + 1)
    step = trust_region_step(made, gradient, radius)
    length = np.linalg.norm(step)
    assert length <= 1.1 * radius
    inside = np.linalg.solve(dense, -gradient)
    if np.linalg.norm(inside) < radius:
        np.testing.assert_allclose(step, inside, rtol=1e-6)
    else:
        # Some damping, the same in all directions, makes it the optimum.
        damping = -(gradient + dense @ step) / step
        np.testing.assert_allclose(damping, damping[0], rtol=1e-6)
        assert damping[0] > 0
        assert length > 0.9 * radius


def test_the_optimum_is_that_of_a_general_method() -> None:
    own, start = estimation(3, 30)
    found = own.minimised(start)
    scale = np.sqrt(own.variance)
    unknowns = own.unknowns

    def cost(flat: np.ndarray) -> float:
        point = own.point(flat)
        prior = (point.starts - unknowns.start[unknowns.free]) / unknowns.start_deviation
        return 0.5 * float(np.sum((own.residual(point) / scale) ** 2) + np.sum(prior**2))

    wanted = minimize(
        cost, found.point.flat, method="Powell", options={"xtol": 1e-9, "ftol": 1e-14}
    )
    assert cost(found.point.flat) - wanted.fun < 1e-4
    deviation = np.sqrt(np.diag(own.covariance(found))[:2])
    assert (np.abs(found.point.shared - [9.0, 0.8]) < 4 * deviation).all()


def test_the_covariance_is_that_of_all_unknowns() -> None:
    own, start = estimation(4, 25)
    found = own.minimised(start)
    curvature = own._curvature(found)
    size = len(curvature.diagonal)
    dense = np.array([curvature.times(each) for each in np.eye(size)])
    mean = np.zeros((4, size))
    mean[:2, :2] = np.eye(2)
    mean[2:, 2:] = np.tile(np.eye(2), 4) / 4
    np.testing.assert_allclose(
        own.covariance(found), mean @ np.linalg.inv(dense) @ mean.T, rtol=1e-7
    )


def test_estimates_do_not_depend_on_how_trajectories_are_divided(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own, start = estimation(7, 25)
    folds = [own.seen[..., 0], ~own.seen[..., 0]]
    whole = held_out(own, start, folds)
    monkeypatch.setattr(module, "CHUNK", 3 * 25 * 2 * 4)
    for one, other in (
        (start, own.linearised(start.point)),
        (whole, held_out(own, start, folds)),
    ):
        for name, value in vars(one).items():
            if name != "point":
                np.testing.assert_allclose(getattr(other, name), value, rtol=1e-9, atol=1e-12)


def test_parts_that_overlap_are_left_out_one_by_one() -> None:
    own, start = estimation(7, 25)
    seen = own.seen[..., 0]
    parts = [seen & (np.arange(25) < 15), seen & (np.arange(25) > 10), ~seen]
    for part, errors in zip(parts, errors_without(own, start, parts), strict=True):
        np.testing.assert_array_equal(errors, held_out(own, start, [part]).errors)


@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_standard_errors_come_from_what_varies_between_records(offset: float) -> None:
    """Each record has an error of its own beside white noise, which the twin does not know."""
    own, start = estimation(20, 25)
    apart = offset * np.random.default_rng(1).normal(size=(20, 1, 2))
    record = own.observed.replace(observed=own.observed.observed + apart)
    own = replace(own, observed=record)
    found = own.minimised(own.linearised(start.point))
    errors, factor = dependent_errors(own, found, 2)
    expected = np.sqrt(np.diag(own.covariance(found))[:2])
    if offset:
        assert (errors > 3 * expected).all()
    else:
        np.testing.assert_allclose(errors, expected, rtol=0.25)
    assert (np.abs(found.point.shared - (9.0, 0.8)) < factor * errors).all()


def test_copies_of_records_count_once() -> None:
    record, rows = estimation(6, 100)[0].observed, [0, 1, 2, 3, 1, 3]
    arrays = {name: getattr(record, name)[rows] for name in ("commands", "observed", "mask")}
    settings = Dynamics(Library(1, (), False), memory=False)
    once = fit_dynamics(OSCILLATOR, record[:4], settings)
    with pytest.warns(UserWarning, match="2 of 6 trajectories are copies"):
        found = fit_dynamics(OSCILLATOR, record.replace(**arrays), settings)
    assert found.parameters == once.parameters
    assert found.errors == once.errors
    assert found.intervals == once.intervals


def test_memory_is_proportional_to_the_number_of_trajectories() -> None:
    """The matrix of all 4002 unknowns, written out, has 128 MB."""
    own, start = estimation(2000, 10)
    tracemalloc.start()
    try:
        own.covariance(own.minimised(start))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 64e6
