"""States with arbitrary coordinates: parameters keep what they explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, FittedDynamics, Library, fit_dynamics

TURN = torch.tensor([[0.8, 0.6], [-1.2, 1.6]], dtype=torch.float64)
"""Speed and current by the states, whose coordinates have no meaning."""
BACK = torch.linalg.inv(TURN)
VOLTAGE = rt.Channels(("voltage",), ("V",))
MEASURED = rt.Channels(("speed", "current"), ("rad/s", "A"))
PARAMETERS = (
    Parameter("resistance", "Ohm", 0.5, 5.0, 2.0),
    Parameter("inertia", "kg m2", 0.005, 0.1, 0.02),
)
TRUTH = {"resistance": 2.6, "inertia": 0.035}


def motor(friction: float) -> StateTwin:
    """An electric motor, with dry friction in N m that only the real one has."""

    def derivative(x, u, p):
        speed, current = (TURN @ torch.stack(list(x))).unbind()
        torque = 0.4 * current - 0.05 * speed - friction * torch.tanh(speed / 0.3)
        lost = u.voltage - p.resistance * current - 0.4 * speed
        return tuple((BACK @ torch.stack([torque / p.inertia, lost / 0.3])).unbind())

    return StateTwin(
        (State("x1", "1", 0.0), State("x2", "1", 0.0)),
        lambda x, u: tuple((TURN @ torch.stack(list(x))).unbind()),
        VOLTAGE,
        MEASURED,
        50.0,
        derivative=derivative,
        parameters=PARAMETERS,
        substeps=4,
        interpolation="hold",
    )


@pytest.fixture(scope="module")
def record() -> rt.Trajectories:
    rng = np.random.default_rng(0)
    voltage = np.repeat(rng.uniform(-12, 12, size=(1, 12, 1)), 50, axis=1)
    made = motor(0.15).simulate(voltage, seed=0, parameters=TRUTH)
    return made.replace(
        observed=made.observed + np.array([0.2, 0.06]) * rng.normal(size=made.observed.shape)
    )


def explained(found: FittedDynamics, record: rt.Trajectories) -> float:
    """The part of the discrepancy that the parameters could explain, over the slope of states."""
    twin = found.twin
    values = np.tile(twin.values, (len(record), 1))
    made = twin.equations.steps().run(record.commands.astype(float), values)[1]
    states, commands = made[:, ::10].reshape(-1, 2), record.commands[:, ::10].reshape(-1, 1)
    x, u = (list(torch.tensor(each, dtype=torch.float64).unbind(1)) for each in (states, commands))

    def slope(**parameters: float) -> np.ndarray:
        p = [torch.tensor(parameters[each.name]) for each in PARAMETERS]
        return torch.stack(motor(0.0).model.evaluate("slope", x, u, p), 1).numpy()

    known, size = slope(**found.parameters), found.twin.domain.speed
    effects = [
        (slope(**{**found.parameters, name: 1.001 * value}) - known) / size
        for name, value in found.parameters.items()
    ]
    basis = np.linalg.qr(np.stack([each.ravel() for each in effects], axis=1))[0]
    missing = ((twin.slope(states, commands) - known) / size).ravel()
    return float(np.linalg.norm(basis.T @ missing) / np.sqrt(len(states)))


@pytest.mark.slow
def test_parameters_of_learned_equations_take_all_that_they_explain(
    record: rt.Trajectories,
) -> None:
    """Terms over states without meaning together imitate what a parameter does."""
    library = Dynamics(library=Library(2, (), True))
    found = fit_dynamics(replace(motor(0.0), learned=True), record, library)
    assert found.figures["rms_after"] < 0.7 * found.figures["rms_before"]
    assert explained(found, record) < 0.06
    for name, value in TRUTH.items():  # those of the linearisation with friction
        assert abs(found.parameters[name] / value - 1) < 0.2
    assert found.reason == ""
    named = fit_dynamics(motor(0.0), record, library)
    assert explained(named, record) > 0.1, "terms of a model have a meaning of their own"
