"""Networks as a form of the discrepancy, and what is known of its structure, on known systems."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from scipy.stats import truncnorm

import retwin as rt
from retwin.errors import InputError
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, FittedDynamics, Library, TanhNetwork, fit_dynamics
from retwin.update.dynamics.arrow import Arrow, bounded_step
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.estimation import Estimation
from retwin.update.dynamics.filter.noise import edges
from retwin.update.dynamics.linearised import Point
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of

pytestmark = pytest.mark.slow

RATE, NOISE = 40.0, 1e-3
STIFFNESS = Parameter("stiffness", "N/m", 10.0, 100.0, 40.0)
DAMPING = Parameter("damping", "N s/m", 0.05, 5.0, 0.6)
GIVEN = {"stiffness": 30.0, "damping": 0.8}
NETWORK = Dynamics(library=None, network=TanhNetwork(4))


def spring(x, u, p):
    return x.velocity, u.force - p.damping * x.velocity - p.stiffness * x.position


TWIN = StateTwin(
    (State("position", "m"), State("velocity", "m/s")),
    lambda x, u: x.position,
    rt.Channels(("force",), ("N",)),
    rt.Channels(("position",), ("m",)),
    RATE,
    derivative=spring,
    parameters=(STIFFNESS, DAMPING),
)


def record(missing, seed: int = 0, count: int = 3, size: float = 8.0, **truth: float):
    """Measured outputs of an oscillator with a further acceleration, and its states."""

    def real(x, u, p):
        velocity, acceleration = spring(x, u, p)
        return velocity, acceleration + missing(x)

    twin, rng = replace(TWIN, derivative=real), np.random.default_rng(seed)
    white, kernel = rng.normal(size=(count, 400)), np.hanning(7)
    force = size * np.apply_along_axis(np.convolve, 1, white, kernel / 2, mode="same")[..., None]
    made = twin.simulate(force, seed=0, parameters=GIVEN | truth)
    noise = NOISE * rng.normal(size=made.observed.shape)
    states = twin.hidden(force, GIVEN | truth)
    return made.replace(observed=made.observed + noise, nominal=made.observed), states


def cubic(x):
    return -120 * x.position**3


def friction(x):
    return -0.5 * torch.tanh(x.velocity / 0.2) - 0.3 * x.velocity * torch.abs(x.velocity)


def nothing(x):
    return 0 * x.position


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@pytest.fixture(scope="module")
def fitted() -> FittedDynamics:
    return fit_dynamics(TWIN, record(cubic, count=1)[0], NETWORK)


def test_a_network_learns_a_structural_error(fitted: FittedDynamics) -> None:
    unseen = record(cubic, seed=10, size=6.0)[0]
    made = fitted.twin.simulate(unseen.commands, seed=0).nominal
    before = TWIN.simulate(unseen.commands, seed=0, parameters=fitted.parameters).observed
    assert fitted.form == TanhNetwork(4)
    assert rms(made - unseen.nominal) < 0.1 * rms(before - unseen.nominal)
    curve = fitted.twin.curve("velocity", "position", relative_to=GIVEN)
    wanted = -120 * curve.values**3
    inside = curve.inside
    assert np.abs(curve.discrepancy - wanted)[inside].max() < 0.1 * np.ptp(wanted[inside])


@pytest.mark.slow
@pytest.mark.parametrize("missing", [cubic, lambda x: -0.4 * x.velocity**2])
def test_beside_a_network_parameters_are_those_of_the_effective_linearisation(missing) -> None:
    """The structural error projected on the effects of the parameters, over the visited states."""
    made, states = record(missing)
    found = fit_dynamics(TWIN, made, NETWORK)
    x = states.reshape(-1, 2)
    lacking = missing(namedtuple("x", "position velocity")(*torch.tensor(x).T)).numpy()
    moved = np.linalg.lstsq(-x, lacking, rcond=None)[0]
    for (name, value), move in zip(GIVEN.items(), moved, strict=True):
        assert abs(found.parameters[name] - value - move) < 5 * found.errors[name] + 0.02 * value


@pytest.mark.slow
def test_a_true_parameter_shift_is_not_explained_by_a_network() -> None:
    shifted = {"stiffness": 55.0, "damping": 1.5}
    made, states = record(nothing, **shifted)
    found = fit_dynamics(TWIN, made, NETWORK)
    for name, value in shifted.items():
        assert abs(found.parameters[name] - value) < 5 * found.errors[name] + 0.02 * value
    where = states.reshape(-1, 2), made.commands.reshape(-1, 1).astype(float)
    delta = found.twin.slope(*where)[:, 1] - (
        where[1][:, 0]
        - found.parameters["damping"] * where[0][:, 1]
        - found.parameters["stiffness"] * where[0][:, 0]
    )
    assert rms(delta) < 0.05 * found.twin.domain.speed[1]


def test_a_saved_network_is_the_same(fitted: FittedDynamics, tmp_path) -> None:
    fitted.twin.save(tmp_path / "model")
    again, commands = (
        DynamicsTwin.load(tmp_path / "model"),
        record(cubic, seed=3, size=6.0)[0].commands,
    )
    one, other = (each.simulate(commands, seed=3).observed for each in (fitted.twin, again))
    np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:at a bound, and perhaps beyond it. damping")
@pytest.mark.parametrize("form", [Library(), TanhNetwork(8)])
def test_known_structure_holds_after_a_fit(form: Library | TanhNetwork) -> None:
    """Over and beyond the domain, and at other places of the other variables."""
    library, network = (form, None) if isinstance(form, Library) else (None, form)
    known = Dynamics(
        library, network=network, depends={"velocity": ("velocity",)}, passive=("velocity",)
    )
    made = record(friction)[0]
    found, free = (fit_dynamics(TWIN, made, each) for each in (known, replace(known, passive=())))
    values, low, high = found.twin.values, found.twin.domain.low[1], found.twin.domain.high[1]
    speed = np.linspace(3 * low, 3 * high, 301)
    where = np.column_stack([np.zeros_like(speed), speed]), np.zeros((301, 1))
    delta = found.twin.slope(*where)[:, 1] + found.parameters["damping"] * speed
    assert len(values) > 4
    assert np.all(delta * speed <= 1e-12)
    assert np.all(np.diff(delta) <= 1e-12)
    unseen = record(friction, seed=10, size=6.0)[0]
    errors = [
        rms(each.twin.simulate(unseen.commands, seed=0).nominal - unseen.nominal)
        for each in (found, free)
    ]
    assert errors[0] < 1.1 * errors[1] + NOISE / 5


VARIABLES = ("position", "velocity", "force")


def sums(form: Library | TanhNetwork, settings: Dynamics, rng: np.random.Generator, where):
    """Discrepancies (k, K) of the equation of the velocity with drawn coefficients in bounds."""
    x, u = rng.normal(size=(2, 50, 2)), rng.normal(size=(2, 50, 1))
    equations = CorrectedEquations.distinct(TWIN, form, settings, (x, u), np.eye(2))
    scaled = equations.domain.scaled(torch.tensor(where).unbind(1))
    made = []
    for _ in range(20):
        drawn = 3 * rng.normal(size=len(equations.coefficients))
        drawn = [
            value if each.low < value < each.high else -value
            for value, each in zip(drawn, equations.coefficients, strict=True)
        ]
        made.append(sum(equations.discrepancies(scaled, drawn)).numpy())
    return np.array(made)


@pytest.mark.parametrize("form", [Library(), TanhNetwork(8)])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("variable", VARIABLES)
def test_monotone_holds_for_all_coefficients_within_their_bounds(form, sign, variable) -> None:
    rng, place = np.random.default_rng(0), VARIABLES.index(variable)
    where = np.tile(3 * rng.normal(size=3), (201, 1))
    where[:, place] = np.linspace(-6, 6, 201)
    depends = {"velocity": VARIABLES}
    known = Dynamics(depends=depends, monotone={"velocity": {variable: sign}})
    found = sums(form, known, rng, where)
    assert np.all(sign * np.diff(found, axis=1) > -1e-12)
    assert np.ptp(found, axis=1).min() > 0
    free = np.diff(sums(form, Dynamics(depends=depends), rng, where), axis=1)
    assert np.any(sign * free < -1e-3), "without that knowledge it is not"


@pytest.mark.parametrize("form", [Library(), TanhNetwork(8)])
def test_passive_holds_for_all_coefficients_within_their_bounds(form) -> None:
    rng = np.random.default_rng(0)
    where = 3 * rng.normal(size=(500, 3))
    known = Dynamics(depends={"velocity": VARIABLES}, passive=("velocity",))
    found = sums(form, known, rng, where)
    assert np.all(found * where[:, 1] <= 1e-12)
    assert np.abs(found).min(axis=0).max() > 0
    where[:, 1] = 0.0
    assert np.abs(sums(form, known, rng, where)).max() < 1e-12


def test_a_discrepancy_depends_on_what_it_may() -> None:
    known = Dynamics(network=TanhNetwork(2), depends={"velocity": ("velocity", "force")})
    for form in known.forms:
        x, u = np.random.default_rng(0).normal(size=(2, 1, 50, 2))
        equations = CorrectedEquations.distinct(TWIN, form, known, (x, u[..., :1]), np.eye(2))
        assert not any("position" in each.name for each in equations.coefficients)


@pytest.mark.parametrize(
    "settings",
    [
        {"library": None},
        {"network": Library()},
        {"passive": "velocity"},
        {"depends": {"velocity": "velocity"}},
        {"monotone": {"velocity": {"position": 2}}},
        {"monotone": {"velocity": {"position": 1}}, "passive": ("velocity",)},
    ],
)
def test_contradictory_settings_are_refused(settings: dict) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(settings))}: "):
        Dynamics(**settings)


@pytest.mark.parametrize(
    "settings",
    [
        {"depends": {"speed": ("velocity",)}},
        {"depends": {"velocity": ("speed",)}},
        {"monotone": {"position": {"velocity": 1}}},
        {"monotone": {"velocity": {"speed": 1}}},
        {"passive": ("position",)},
    ],
)
def test_unknown_states_and_variables_are_refused(settings: dict) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(settings))}: "):
        fit_dynamics(TWIN, record(cubic, count=1)[0], Dynamics(Library(0, (), False), **settings))


@pytest.mark.parametrize("below", [0.0, 0.3, 1.0, 3.0])
def test_the_posterior_at_a_bound_is_as_wide_as_its_allowed_part(below: float) -> None:
    """Against the second moment about the bound of a truncated normal distribution."""
    level = StateTwin(
        (State("level", "m"),),
        lambda x, u, p: p.offset + 0 * x.level,
        rt.Channels(("valve",), ("1",)),
        rt.Channels(("level",), ("m",)),
        1.0,
        derivative=lambda x, u, p: (0 * u.valve,),
        parameters=(Parameter("offset", "m", 0.0, 9.0, 1.0),),
    )
    samples = 100
    made = level.simulate(np.zeros((1, samples, 1)), seed=0)
    made = made.replace(observed=0 * made.observed - below / np.sqrt(samples))
    base, free, values = state_twin_of(level)
    unknowns = unknowns_of(base, free, values)
    own = Estimation(base, made, unknowns, made.mask, np.ones(1))
    found = own.minimised(own.linearised(Point(unknowns.mean, np.zeros((1, 0)))))
    assert found.point.shared == pytest.approx([0.0], abs=1e-9)
    allowed = truncnorm(below, np.inf, loc=-below)
    second = allowed.mean() ** 2 + allowed.var()
    assert second <= own.covariance(found)[0, 0] * samples * (1 + 1e-6) <= 1.5 * second


def test_a_step_within_bounds_is_that_of_the_quadratic_program() -> None:
    """Against a solver for bounds, on problems whose unknowns are strongly correlated."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.normal(size=(6, 6)) * np.geomspace(1, 30, 6)
        curvature, gradient = root @ root.T + 0.1 * np.eye(6), 10 * rng.normal(size=6)
        arrow = Arrow(curvature, np.zeros((1, 0, 6)), np.zeros((1, 0, 0)))
        low, high = -rng.random(6), rng.random(6)
        step = bounded_step(arrow, gradient, 1e6, low, high)
        best = lsq_linear(
            np.linalg.cholesky(curvature).T,
            -np.linalg.solve(np.linalg.cholesky(curvature), gradient),
            (low, high),
        ).x
        value, least = (each @ (gradient + curvature @ each / 2) for each in (step, best))
        assert np.all((low - 1e-12 <= step) & (step <= high + 1e-12))
        assert value < 0.5 * least


def test_edges_hold_the_ends_of_each_variable() -> None:
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.normal(size=(3, 400, 1)), axis=1)
    commands = rng.normal(size=(3, 400, 1))
    parts = edges(states, commands, 10)
    assert len(parts) == 4
    for part, variable in zip(parts, (states, -states, commands, -commands), strict=True):
        assert 0.02 < part.mean() < 0.35
        assert part.reshape(-1)[np.argmax(variable)]
        assert variable[part].mean() > variable.mean()
