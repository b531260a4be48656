from __future__ import annotations

import subprocess
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import retwin as rt
from retwin import compiler
from retwin.evaluation.fidelity.simulation import simulate_records
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.twins import Parameter, ParametricTwin, State, StateTwin
from retwin.twins.equations.interpolation import INTERPOLATIONS, cubic_coefficients
from retwin.update.identification import LeastSquares, identify

VOLTAGE = rt.Channels(("pump",), ("V",))
LEVEL = rt.Channels(("level",), ("V",))
FORCE = rt.Channels(("force",), ("N",))
MOTION = rt.Channels(("position", "power"), ("m", "W"))
STIFFNESS = Parameter("stiffness", "N/m", 1.0, 100.0, 40.0)
DAMPING = Parameter("damping", "N s/m", 0.1, 5.0, 0.6)
CUBIC = Parameter("cubic", "N/m^3", 0.0, 50.0, 20.0)


def oscillator(x, u, p):
    return x.velocity, u.force - p.damping * x.velocity - p.stiffness * x.position - (
        p.cubic * x.position**3
    )


def motion(x, u):
    return x.position, u.force * x.velocity


def duffing(**settings) -> StateTwin:
    return StateTwin(
        (State("position", "m", 0.1), State("velocity", "m/s", -0.2, -1.0, 1.0)),
        motion,
        FORCE,
        MOTION,
        50.0,
        derivative=oscillator,
        parameters=(STIFFNESS, DAMPING, CUBIC),
        **settings,
    )


def every_operation(x, u, p):
    """A state that stays small, by all operations that equations use."""
    a, b = x.a, u.u + 2
    both = torch.stack([a, b])
    mixed = torch.tensor([[0.3, -0.2], [0.1, 0.4]], dtype=torch.float64) @ both
    smooth = torch.sin(a) + torch.cos(b) + torch.tanh(a * b) + torch.exp(-a * a) + torch.atan(b)
    roots = torch.sqrt(b) + b**0.5 + b**p.power + torch.log(b) + torch.log1p(b) + b**-2 + 2**a
    kinks = a.abs() + torch.relu(a) + a.clamp(-0.1, 0.1) + torch.maximum(a, b) + torch.sign(a)
    curves = torch.sigmoid(a) + torch.expm1(a) + torch.erf(a) + torch.atan2(a, b) + 1 / b
    rest = torch.sinh(a) + torch.cosh(a) + torch.asin(a / 9) + torch.acos(a / 9) + torch.tan(a)
    chosen = torch.where((a > 0) & ~(b < 1), smooth, roots) + torch.minimum(a, 1 - b) + mixed.sum()
    return -3 * a + 0.05 * (smooth + roots + kinks + curves + rest + chosen) * u.u


def of_all(**settings) -> StateTwin:
    power = Parameter("power", "1", 0.5, 2.0, 0.7)
    return StateTwin(
        (State("a", start=0.3),),
        lambda x, u: x.a,
        rt.Channels(("u",), ("1",)),
        rt.Channels(("y",), ("1",)),
        20.0,
        derivative=every_operation,
        parameters=(power,),
        **settings,
    )


def filtered(x, u, p):
    return p.pole * x.level + (1 - p.pole) * u.pump


def lag(**settings) -> StateTwin:
    return StateTwin(
        (State("level"),),
        level,
        VOLTAGE,
        LEVEL,
        10.0,
        step=filtered,
        parameters=(Parameter("pole", "1", 0.0, 1.0, 0.8),),
        **settings,
    )


def level(x, u, p):
    return x.level


def noise(count: int, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, steps, 1)).cumsum(axis=1) / 3


def in_torch(twin: StateTwin, commands: np.ndarray) -> np.ndarray:
    return twin(torch.as_tensor(commands)).numpy()


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_compiled_and_torch_agree(interpolation: str) -> None:
    for twin in (duffing(interpolation=interpolation, substeps=2), of_all()):
        commands = np.clip(noise(3, 200), -1, 1)
        made = twin.simulate(commands, seed=0).observed
        np.testing.assert_allclose(made, in_torch(twin, commands), rtol=1e-9, atol=1e-12)
    commands = noise(2, 100)
    made = lag().simulate(commands, seed=0).observed
    np.testing.assert_allclose(made, in_torch(lag(), commands), rtol=1e-9)


def test_the_traced_function_is_the_users() -> None:
    twin = of_all()
    groups = [torch.linspace(-1, 1, 9).double(), torch.linspace(-0.9, 2, 9).double()]
    for a, u in zip(*groups, strict=True):
        from types import SimpleNamespace as Of

        wanted = every_operation(Of(a=a), Of(u=u), Of(power=torch.tensor(0.7).double()))
        found = twin.model.evaluate("slope", [a], [u], [torch.tensor(0.7).double()])
        assert torch.allclose(found[0], wanted, rtol=1e-12)


@pytest.mark.parametrize("twin", [duffing(interpolation="spline", substeps=3), of_all(), lag()])
def test_sensitivities_are_those_of_torch_and_of_differences(twin: StateTwin) -> None:
    commands = np.clip(noise(2, 60), -1, 1)
    made, derivatives = twin.sensitivities(commands)
    assert derivatives.shape == (*made.shape, len(twin.names))
    values = twin.values(None, 2)
    for column, name in enumerate(twin.names):
        ends = [{name: values[:, column] + sign * 1e-6} for sign in (-1, 1)]
        low, high = (twin.simulate(commands, seed=0, parameters=each).observed for each in ends)
        found = derivatives[..., column]
        scale = np.abs(found).max()
        np.testing.assert_allclose(found, (high - low) / 2e-6, atol=1e-5 * scale + 1e-8)
        start = torch.tensor(values[:, column], requires_grad=True)
        at = torch.as_tensor(commands).requires_grad_()
        twin(at, {name: start})[:, -1, 0].sum().backward()
        np.testing.assert_allclose(start.grad, found[:, -1, 0], rtol=1e-8, atol=1e-10 * scale)
        assert at.grad.isfinite().all()
        assert at.grad.any()


def test_without_a_compiler_torch_gives_the_same(monkeypatch) -> None:
    twin, commands = duffing(substeps=2), noise(2, 30)
    wanted, derivatives = twin.sensitivities(commands)
    monkeypatch.setattr(compiler, "compilers", list)
    compiler.compiled.cache_clear()
    with pytest.warns(UserWarning, match="no C compiler .none is installed.*retwin.compiled"):
        made = duffing(substeps=2).simulate(commands, seed=0).observed
    np.testing.assert_allclose(made, wanted, rtol=1e-9, atol=1e-12)
    found = twin.sensitivities(commands)[1]
    np.testing.assert_allclose(found, derivatives, rtol=1e-9, atol=1e-12)
    compiler.compiled.cache_clear()


def test_the_source_is_strict_c99(tmp_path) -> None:
    for number, twin in enumerate((duffing(), of_all(), lag())):
        file = tmp_path / f"{number}.c"
        file.write_text(twin.model.source)
        (command, *_) = compiler.compilers()
        strict = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-c")
        subprocess.run([*command, *strict, file, "-o", tmp_path / "o"], check=True)


def test_a_small_network_is_traced_with_its_weights() -> None:
    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(2, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1)
    ).double()
    twin = replace(
        stiff_twin(1.0), derivative=lambda x, u, p: net(torch.stack([x.level, u.pump]))[0] - x.level
    )
    commands = noise(2, 50)
    made = twin.simulate(commands, seed=0).observed
    np.testing.assert_allclose(made, in_torch(twin, commands), rtol=1e-9, atol=1e-12)
    now = torch.tensor([0.3, -0.2]).double()
    (slope,) = twin.model.evaluate("slope", [now[0]], [now[1]], [now[0]])
    assert slope.item() == pytest.approx((net(now)[0] - now[0]).item(), rel=1e-12)


@pytest.mark.parametrize("interpolation", ["hold", "linear", "spline"])
def test_a_single_sample_is_held(interpolation: str) -> None:
    found = cubic_coefficients(torch.tensor([[[3.0]]], dtype=torch.float64), interpolation)
    assert found.ravel().tolist() == [3.0, 0.0, 0.0, 0.0]


def test_interpolation_is_closed_form() -> None:
    commands = noise(2, 40)
    grid = np.linspace(0, 1, 5)[:-1]
    times = np.arange(39)[:, None] + grid
    made = {}
    for name in INTERPOLATIONS:
        c = cubic_coefficients(torch.as_tensor(commands), name).numpy()
        assert (c[:, -1, 1:] == 0).all()
        powers = grid[:, None] ** np.arange(4)
        made[name] = np.einsum("ntpu,gp->ntgu", c[:, :-1], powers)
    samples = np.arange(40)
    for row in range(2):
        u = commands[row, :, 0]
        straight = np.interp(times, samples, u)
        spline = CubicSpline(samples, u, bc_type="natural")(times)
        np.testing.assert_array_equal(made["hold"][row, ..., 0], np.repeat(u[:-1, None], 4, 1))
        np.testing.assert_allclose(made["linear"][row, ..., 0], straight, atol=1e-12)
        np.testing.assert_allclose(made["spline"][row, ..., 0], spline, atol=1e-12)
    for short in (2, 3, 5):
        c = cubic_coefficients(torch.as_tensor(commands[:, :short]), "spline")[0, 0, 1].numpy()
        wanted = CubicSpline(range(short), commands[0, :short], bc_type="natural")(0.0, 1)
        np.testing.assert_allclose(c, wanted, atol=1e-12)


def test_a_causal_spline_ends_at_the_next_sample() -> None:
    commands = np.concatenate([np.tile(noise(2, 1), (1, 25, 1)), noise(2, 40)], axis=1)
    found = cubic_coefficients(torch.as_tensor(commands), "spline", causal=True).numpy()
    for k in range(25, 64):
        until = CubicSpline(range(k + 2), commands[:, : k + 2], axis=1, bc_type="natural")
        np.testing.assert_allclose(found[:, k, 1], until(k, 1), atol=1e-11)
        np.testing.assert_allclose(found[:, k].sum(axis=1), commands[:, k + 1], atol=1e-11)


def test_it_solves_the_equations() -> None:
    commands = noise(1, 100)
    twin = duffing(interpolation="linear", substeps=8)
    samples = np.arange(100) / 50.0
    p = type("P", (), {"stiffness": 40.0, "damping": 0.6, "cubic": 20.0})

    def slope(t, z):
        x = type("X", (), {"position": z[0], "velocity": z[1]})
        u = type("U", (), {"force": np.interp(t, samples, commands[0, :, 0])})
        return oscillator(x, u, p)

    solved = solve_ivp(slope, (0, samples[-1]), (0.1, -0.2), t_eval=samples, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(twin.hidden(commands)[0], solved.y.T, atol=1e-6)
    held = duffing(substeps=8).hidden(commands)
    assert np.abs(held[0] - solved.y.T).max() > 1e-3


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_a_twin_without_commands_decays(interpolation: str) -> None:
    twin = StateTwin(
        (State("level", "V", 2.0),),
        level,
        rt.Channels((), ()),
        LEVEL,
        10.0,
        derivative=lambda x, u, p: -p.rate * x.level,
        parameters=(Parameter("rate", "1/s", 0.0, 5.0, 1.5),),
        interpolation=interpolation,
    )
    commands, times = np.zeros((2, 30, 0)), np.arange(30) / 10
    wanted = 2 * np.exp(-1.5 * times)
    made, derivatives = twin.sensitivities(commands)
    np.testing.assert_allclose(made[1, :, 0], wanted, rtol=1e-4)
    np.testing.assert_allclose(made, in_torch(twin, commands), rtol=1e-9)
    np.testing.assert_allclose(derivatives[0, :, 0, 0], -times * wanted, atol=1e-4)


def test_a_trajectory_does_not_depend_on_the_batch_and_repeats() -> None:
    commands = noise(5, 60)
    whole = duffing().simulate(commands[:, ::-1][:, ::-1], seed=0).observed  # any strides
    np.testing.assert_array_equal(
        duffing().hidden(commands[::-1])[::-1], duffing().hidden(commands)
    )
    alone = [duffing().simulate(each[None], seed=1).observed[0] for each in commands]
    np.testing.assert_array_equal(whole, alone)


def test_starts_and_parameters_may_differ_between_trajectories() -> None:
    commands = np.zeros((3, 20, 1))
    starts = {"start_position": [0.0, 0.1, 0.2], "start_velocity": 0.0}
    made = duffing().simulate(commands, seed=0, parameters=starts).observed
    np.testing.assert_array_equal(made[:, 0, 0], starts["start_position"])
    with pytest.raises(rt.InputError, match="start_position"):
        duffing().simulate(commands, seed=0, parameters={"start": 0.0})
    with pytest.raises(rt.InputError, match="start_position"):
        duffing()(torch.zeros(1, 5, 1), {"start": 0.0})


def test_identification_finds_the_parameters_and_the_unknown_start() -> None:
    free = duffing(substeps=2).parametric()
    assert free.names == ("stiffness", "damping", "cubic", "start_velocity")
    truth = {"stiffness": 50.0, "damping": 0.4, "cubic": 10.0, "start_velocity": 0.3}
    record = free.with_values(truth).simulate(8 * noise(2, 200), seed=0)
    found = identify(free, record, seed=0, method=LeastSquares(starts=1))
    for name, value in zip(free.names, found.twin.values, strict=True):
        assert value == pytest.approx(truth[name], rel=1e-3)
    derivatives = free.sensitivities(record.commands, np.array(free.values))
    assert derivatives.shape == (2, 200, 2, 4)
    places = {"stiffness": 2.0, "damping": 0.01}
    both = ParametricTwin(duffing(), (Parameter("size", "1", 0.0, 50.0, 20.0, places),))
    commands, h = noise(1, 50), 1e-5
    ends = [
        both.simulate(commands, seed=0, parameters={"size": 20.0 + sign * h}).observed
        for sign in (-1, 1)
    ]
    made = both.sensitivities(commands, np.array([20.0]))[..., 0]
    np.testing.assert_allclose(made, (ends[1] - ends[0]) / (2 * h), atol=1e-8)


def stiff(x, u, p):
    return p.rate * (u.pump - x.level)


def stiff_twin(rate: float, **settings) -> StateTwin:
    free = Parameter("rate", "1/s", 0.0, 1e4, rate)
    return StateTwin(
        (State("level"),),
        level,
        VOLTAGE,
        LEVEL,
        10.0,
        derivative=stiff,
        parameters=(free,),
        **settings,
    )


def test_a_stiff_twin_warns_that_it_needs_substeps() -> None:
    commands = noise(2, 400)
    with pytest.warns(rt.twins.StepWarning, match="level has an error of .* V with substeps=1"):
        stiff_twin(26.0).simulate(commands, seed=0)
    with pytest.raises(rt.twins.SimulationError, match="finite with 16: give more substeps"):
        stiff_twin(200.0).simulate(commands, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stiff_twin(200.0, substeps=100).simulate(commands, seed=0)


def escaping(x, u, p):
    return x.level**2


def test_a_simulation_that_diverges_fails_alone() -> None:
    twin = replace(stiff_twin(1.0), derivative=escaping, parameters=())
    starts = {"start_level": [0.1, 100.0, 0.2]}
    with pytest.raises(rt.twins.SimulationError, match=r"1 of 3.*trajectory 1.*check") as caught:
        twin.simulate(noise(3, 30), seed=0, parameters=starts)
    assert np.isfinite(caught.value.finished.observed).all()


@pytest.mark.parametrize(
    ("by_numpy", "by_torch"),
    [
        (lambda x: np.sqrt(1 + x) + np.float64(2) * x, lambda x: torch.sqrt(1 + x) + 2 * x),
        (lambda x: np.where(x > 0.1, -x, np.abs(x)), lambda x: torch.where(x > 0.1, -x, x.abs())),
        (lambda x: np.log10(x + 2) + np.log2(x + 2), lambda x: torch.log(x + 2) * 1.8769897227),
        (lambda x: np.maximum(x, 0.2) ** 2 - np.pi, lambda x: x.clamp(min=0.2) ** 2 - np.pi),
        (lambda x: np.arctan2(x, 2) + np.power(x, 2), lambda x: torch.atan(x / 2) + x * x),
        (lambda x: np.clip(x, -1, 0.2) * np.tanh(x), lambda x: x.clamp(-1, 0.2) * torch.tanh(x)),
    ],
)
def test_equations_may_be_written_with_numpy(by_numpy, by_torch) -> None:
    made = [
        replace(stiff_twin(1.0), derivative=lambda x, u, own=own: own(x.level) + u.pump)
        .simulate(noise(2, 20), seed=0)
        .observed
        for own in (by_numpy, by_torch)
    ]
    np.testing.assert_allclose(made[0], made[1], rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, u, p: x.level if x.level > 0 else u.pump, "number taken out of a tensor"),
        (lambda x, u, p: float(x.level), "number taken out of a tensor"),
        (lambda x, u, p: torch.special.bessel_j0(x.level), "bessel_j0"),
        (lambda x, u, p: x.level.float(), "torch.float32"),
        (lambda x, u, p: np.array([x.level]), "number taken out of a tensor"),
        (lambda x, u, p: np.add.accumulate(x.level), "numpy.add with accumulate"),
        (lambda x, u, p: np.gcd(x.level, 2), "torch.gcd"),
        (lambda x, u, p: (x.level, u.pump), "1 scalars.*got 2"),
        (lambda x, u, p: None, "1 scalars"),
        (lambda x, u, p: x.level.add_(u.pump), "in place"),
    ],
)
def test_what_cannot_be_traced_is_refused_by_name(function, message: str) -> None:
    twin = replace(stiff_twin(1.0), derivative=function)
    with pytest.raises(rt.InputError, match=message):
        twin.simulate(noise(1, 10), seed=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step": stiff}, "either derivative or step"),
        ({"derivative": None}, "either derivative or step"),
        ({"substeps": 0}, "substeps"),
        ({"interpolation": "cubic"}, "interpolation"),
        ({"states": ()}, "states"),
        ({"states": (State("a"), State("a"))}, "different names"),
        ({"derivative": None, "step": stiff, "interpolation": "linear"}, "step"),
        ({"rate": 0.0}, "rate"),
    ],
)
def test_settings_without_sense_are_refused(settings, message: str) -> None:
    with pytest.raises(rt.InputError, match=message):
        replace(stiff_twin(1.0), **settings)
    with pytest.raises(rt.InputError, match="state 'a'"):
        State("a", low=0.0)


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    "twin", [duffing(interpolation="linear"), lag(limits=rt.Limits((-9,), (9,)))]
)
def test_contract(twin: StateTwin, check) -> None:
    check(TwinSubject(twin, noise(3, 30)))


def test_it_stands_in_for_a_surrogate_with_gradient() -> None:
    from retwin.update.exact import exact_surrogate

    surrogate = exact_surrogate(duffing())
    commands = torch.as_tensor(noise(1, 20)).requires_grad_()
    surrogate(commands).sum().backward()
    assert commands.grad.any()


def test_a_record_is_simulated_once_and_scored_as_equal_draws(monkeypatch) -> None:
    free = duffing(substeps=2).parametric()
    records = free.simulate(noise(2, 50), seed=0)
    records = records.replace(observed=records.observed + 0.1)
    once = simulate_records(free, records, draws=20, seed=0)
    monkeypatch.setattr(StateTwin, "deterministic", False)
    often = simulate_records(free, records, draws=20, seed=0)
    for name in ("mean", "bands", "crps"):
        np.testing.assert_allclose(getattr(once, name), getattr(often, name), rtol=1e-9)


CASE = """
name = "tank"
twin = "state_tank:tank"
correction = "additive"

[parameters]
pole = { unit = "1", low = 0.1, high = 0.9, start = 0.5 }

[commands]
kind = "HoldSampler"
low = [0.0]
high = [1.0]
rate = 10.0
duration = 5.0
hold_durations = [0.5, 1.0]
"""
MODULE = """
import retwin as rt
from retwin.twins import Parameter, ParametricTwin, State, StateTwin

tank = StateTwin(
    states=[State("level", "V", start=0.2)],
    output=lambda x, u: x.level,
    inputs=rt.Channels(("pump",), ("V",)),
    outputs=rt.Channels(("level",), ("V",)),
    rate=10.0,
    step=lambda x, u, p: p.pole * x.level + (1 - p.pole) * u.pump,
    parameters=[Parameter("pole", "1", 0.0, 1.0, 0.8)],
)
"""


def test_a_case_file_names_it(tmp_path) -> None:
    (tmp_path / "state_tank.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE)
    case = rt.cases.get(str(tmp_path / "case.toml"))
    made = case.parametric.simulate(np.ones((1, 3, 1)), seed=0).observed[0, :, 0]
    np.testing.assert_allclose(made, [0.2, 0.6, 0.8])
    (tmp_path / "case.toml").write_text(CASE.replace("[parameters]\npole", "# pole"))
    assert rt.cases.get(str(tmp_path / "case.toml")).parametric.values == (0.8,)
