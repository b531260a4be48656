"""Networks as a form of the discrepancy, and what is known of its structure, on known systems."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.errors import InputError
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, FittedDynamics, Library, TanhNetwork, fit_dynamics

RATE, NOISE = 40.0, 1e-3
STIFFNESS = Parameter("stiffness", "N/m", 10.0, 100.0, 40.0)
DAMPING = Parameter("damping", "N s/m", 0.05, 5.0, 0.6)
GIVEN = {"stiffness": 30.0, "damping": 0.8}
NETWORK = Dynamics(library=None, network=TanhNetwork(8))


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
    return fit_dynamics(TWIN, record(cubic)[0], NETWORK)


def test_a_network_learns_a_structural_error(fitted: FittedDynamics) -> None:
    unseen = record(cubic, seed=10, size=6.0)[0]
    made = fitted.twin.simulate(unseen.commands, seed=0).nominal
    before = TWIN.simulate(unseen.commands, seed=0, parameters=fitted.parameters).observed
    assert fitted.form == TanhNetwork(8)
    assert rms(made - unseen.nominal) < 0.1 * rms(before - unseen.nominal)
    curve = fitted.twin.curve("velocity", "position", relative_to=GIVEN)
    wanted = -120 * curve.values**3
    inside = curve.inside
    assert np.abs(curve.discrepancy - wanted)[inside].max() < 0.1 * np.ptp(wanted[inside])


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
    again, commands = DynamicsTwin.load(tmp_path / "model"), record(cubic, seed=3, size=6.0)[0].commands
    one, other = (each.simulate(commands, seed=3).observed for each in (fitted.twin, again))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("form", [Library(), TanhNetwork(8)])
def test_known_structure_holds_everywhere(form: Library | TanhNetwork) -> None:
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
