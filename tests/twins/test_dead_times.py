"""Dead times of the commands of a `StateTwin`, against commands that are shifted by hand."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin import compiler
from retwin.errors import InputError
from retwin.twins import Parameter, ParameterShift, State, StateTwin
from retwin.twins.equations.interpolation import INTERPOLATIONS
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics
from retwin.update.dynamics.filter.online import OnlineFilter

RATE = 10.0
DEAD = np.array([0.0, 0.31, 0.77])
DISCRETE = "step"


def heated(kind: str = "hold", **settings) -> StateTwin:
    """A first-order lag of a flow with a dead time, and of a power without one."""
    equations = {
        "derivative": lambda x, u, p: ((p.gain * u.flow + u.power - x.heat) / p.lag,),
        "step": lambda x, u, p: (x.heat + 0.1 * (p.gain * u.flow + u.power - x.heat) / p.lag,),
    }
    name = "step" if kind == DISCRETE else "derivative"
    given = {
        "parameters": (
            Parameter("gain", "K", 0.1, 5.0, 1.0),
            Parameter("lag", "s", 0.05, 5.0, 1.0),
            Parameter("dead", "s", 0.0, 3.0, 0.4),
        ),
        "delays": {"flow": "dead"},
        name: equations[name],
        "output": lambda x, u: (x.heat, x.heat + 0.5 * u.flow),
        "outputs": rt.Channels(("heat", "mixed"), ("K", "K")),
    }
    if kind != DISCRETE:
        given["interpolation"] = kind
    inputs = rt.Channels(("power", "flow"), ("K", "1"))
    return StateTwin((State("heat", "K"),), inputs=inputs, rate=RATE, **(given | settings))


def commanded(count: int, samples: int, held: int = 1) -> np.ndarray:
    drawn = np.random.default_rng(0).normal(size=(count, samples // held, 2))
    return np.repeat(drawn, held, axis=1)


def measured(dead: float, gain: float, lag: float, commands: np.ndarray, noise: float = 0.0):
    """The exact heat for held commands, where the late flow changes inside of samples."""
    fine = 100
    steps = np.repeat(commands, fine, axis=1)
    late = np.maximum(np.arange(steps.shape[1]) - round(dead * RATE * fine), 0)
    drive = gain * steps[:, late, 1] + steps[..., 0]
    heat, made = np.zeros(len(commands)), []
    for k in range(steps.shape[1]):
        if k % fine == 0:
            made.append(heat)
        heat = heat + (drive[:, k] - heat) * -np.expm1(-1 / (RATE * fine * lag))
    outputs = np.stack(made, 1)[..., None]
    drawn = noise * np.random.default_rng(1).normal(size=outputs.shape)
    return heater().simulate(commands, seed=0).replace(observed=outputs + drawn)


def heater() -> StateTwin:
    """The same with one output."""
    channels = rt.Channels(("heat",), ("K",))
    return heated(substeps=2, output=lambda x, u: x.heat, outputs=channels)


@pytest.mark.parametrize("kind", [*INTERPOLATIONS, DISCRETE])
def test_compiled_and_torch_agree_with_commands_shifted_by_hand(kind: str, monkeypatch) -> None:
    twin, u = heated(kind), commanded(3, 60, 2)
    made = twin.simulate(u, seed=0, parameters={"dead": DEAD}).observed
    in_torch = twin(torch.as_tensor(u), {"dead": torch.as_tensor(DEAD)}).numpy()
    np.testing.assert_allclose(in_torch, made, atol=1e-9)
    late = u.copy()
    for own, delay in zip(late, DEAD, strict=True):
        before = np.arange(60) - delay * RATE  # beyond the first sample numpy takes the first one
        own[:, 1] = np.interp(before, np.arange(60), own[:, 1])
    plain = replace(twin, delays={})
    if kind == "spline":  # a straight line between two shifted splines, which begin apart
        late, made, plain = late[:1], made[:1], replace(plain, delays={})
    np.testing.assert_allclose(plain.simulate(late, seed=0).observed, made, atol=1e-9)
    derivatives = twin.sensitivities(u, {"dead": DEAD})[1]
    monkeypatch.setattr(compiler, "compilers", list)
    compiler.compiled.cache_clear()
    with pytest.warns(UserWarning, match="no C compiler"):
        found = heated(kind).sensitivities(u, {"dead": DEAD})
    compiler.compiled.cache_clear()
    np.testing.assert_allclose(found[1], derivatives, atol=1e-9)


@pytest.mark.parametrize("kind", [*INTERPOLATIONS, DISCRETE])
def test_the_derivative_by_the_dead_time_is_that_of_differences(kind: str) -> None:
    twin, u, step = heated(kind), commanded(2, 50), 1e-5
    dead = DEAD[1:]
    exact = twin.sensitivities(u, {"dead": dead})[1][..., twin.names.index("dead")]
    up, down = (twin.sensitivities(u, {"dead": dead + d})[0] for d in (step, -step))
    np.testing.assert_allclose(exact, (up - down) / (2 * step), atol=1e-8)
    assert np.abs(exact).max() > 1


@pytest.mark.parametrize("start", [0.0, 2.8])
def test_identify_finds_a_dead_time_many_samples_away(start: float) -> None:
    """The commands change in each sample, so that errors have a minimum at every dead time."""
    record = measured(0.31, 2.0, 0.6, commanded(1, 300), noise=0.02)
    twin = heater().parametric().with_values({"dead": start, "gain": 0.5})
    found = rt.identify(twin, record, seed=0)
    assert found.values["gain"] == pytest.approx(2.0, abs=0.02)
    assert found.values["lag"] == pytest.approx(0.6, abs=0.01)
    assert found.values["dead"] == pytest.approx(0.31, abs=0.005)


def test_fit_dynamics_finds_it_and_predicts_with_it(tmp_path) -> None:
    record = measured(1.27, 2.0, 0.6, commanded(2, 300), noise=0.02)
    wrong = heater().parametric().with_values({"dead": 2.9})
    fitted = fit_dynamics(wrong, record, Dynamics(Library(0, (), False)))
    assert fitted.parameters["dead"] == pytest.approx(1.27, abs=0.005)
    assert 0 < fitted.errors["dead"] < 0.01
    assert fitted.figures["rms_after"] < 0.03
    fitted.twin.save(tmp_path / "model")
    again = DynamicsTwin.load(tmp_path / "model")
    u = record.commands.astype(np.float64)
    np.testing.assert_array_equal(
        again.simulate(u, seed=1).observed, fitted.twin.simulate(u, seed=1).observed
    )
    # Online, a command acts as long after it came as in a whole record.
    known, online = again.filter, OnlineFilter(again)
    seen, y = record.mask, np.where(record.mask, record.observed, 0.0).astype(np.float64)
    whole, state, found = known(u, y, seen, known_start=False)[0], online.start(2), []
    for first in range(0, 300, 20):
        part = slice(first, first + 20)
        state, mean, _ = online.step(state, u[:, part], y[:, part], seen[:, part])
        found.append(mean)
    # One sample of propagation lies between the two starts.
    np.testing.assert_allclose(np.concatenate(found, 1)[:, 60:], whole[:, 60:], atol=1e-6)


def test_it_is_kept_by_copies_and_for_its_fingerprint() -> None:
    twin, u = heated(), commanded(1, 40)
    again = pickle.loads(pickle.dumps(twin))
    assert again.delays == twin.delays
    np.testing.assert_array_equal(again.sensitivities(u)[1], twin.sensitivities(u)[1])
    assert twin.fingerprint != replace(twin, delays={}).fingerprint


def test_what_cannot_be_a_dead_time_is_refused_by_name() -> None:
    u = commanded(1, 20)
    for delays, name in (({"steam": "dead"}, "steam"), ({"flow": "none"}, "none")):
        with pytest.raises(InputError, match=rf"delays.*{name}"):
            heated(delays=delays)
    with pytest.raises(InputError, match=r"delays: expected a parameter in s.*gain in K"):
        heated(delays={"flow": "gain"})
    with pytest.raises(InputError, match="dead: expected"):
        heated().simulate(u, seed=0, parameters={"dead": -0.1})
    with pytest.raises(InputError, match=r"expected one of the parameters gain, lag, got.*dead"):
        heated().simulate(u, faults=[ParameterShift("dead", size=0.1)], seed=0)
    shifted = heated().simulate(u, faults=[ParameterShift("lag", size=0.1)], seed=0)
    assert np.abs(shifted.residual).max() > 0


MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin

heater = StateTwin(
    states=[State("heat", "K")],
    output=lambda x, u: x.heat,
    inputs=rt.Channels(("flow",), ("1",)),
    outputs=rt.Channels(("heat",), ("K",)),
    rate=10.0,
    step=lambda x, u, p: p.gain * u.flow,
    parameters=[Parameter("gain", "K", 0.1, 5.0, 2.0)],
)
"""
CASE = """
name = "heater"
twin = "dead_heater:heater"
correction = "additive"

[delays]
flow = { low = 0.0, high = 3.0, start = 0.15 }

[commands]
kind = "HoldSampler"
low = [0.0]
high = [1.0]
rate = 10.0
duration = 5.0
hold_durations = [0.5, 1.0]
"""


def test_a_case_file_gives_them(tmp_path) -> None:
    (tmp_path / "dead_heater.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE)
    updated = 'based_on = "case.toml"\n[parameters]\n'
    updated += '{} = {{ unit = "{}", low = 0.0, high = 4.0, start = {} }}\n'
    (tmp_path / "updated.toml").write_text(updated.format("delay_flow", "s", 0.3))
    (tmp_path / "gain.toml").write_text(updated.format("gain", "K", 3.0))
    commands = np.repeat([0.0, 1.0], [3, 4])[None, :, None]
    for name, expected in (
        ("case", [0, 0, 0, 0, 0, 1, 2]),
        ("updated", [0, 0, 0, 0, 0, 0, 0]),
        ("gain", [0, 0, 0, 0, 0, 1.5, 3]),
    ):
        twin = rt.cases.get(str(tmp_path / f"{name}.toml")).parametric
        assert "delay_flow" in twin.names
        made = twin.simulate(commands, seed=0).observed[0, :, 0]
        np.testing.assert_allclose(made, expected, atol=1e-6)
    wrong = CASE.replace("flow =", "steam =")
    (tmp_path / "case.toml").write_text(wrong)
    with pytest.raises(InputError, match=r"case.toml.*delays.*steam"):
        rt.cases.get(str(tmp_path / "case.toml"))
    table = "rate = 10.0\ninputs = { flow = {} }\noutputs = { heat = {} }\n\n[delays]"
    other = CASE.replace("dead_heater:heater", "dead_function:slow").replace("[delays]", table)
    (tmp_path / "case.toml").write_text(other)
    (tmp_path / "dead_function.py").write_text("def slow(commands):\n    return commands\n")
    with pytest.raises(InputError, match=r"delays: expected dead times of a .*StateTwin"):
        rt.cases.get(str(tmp_path / "case.toml"))
