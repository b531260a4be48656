"""Twins as FMUs: against the twins themselves, in fmpy and in a C program."""

from __future__ import annotations

import subprocess
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri
from test_readme import python_of

import retwin as rt
from retwin.compiler import compilers
from retwin.deploy.fmu.export import export_fmu
from retwin.errors import InputError
from retwin.twins import Parameter, ParameterShift, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics

fmpy = pytest.importorskip("fmpy")

STEPS = 60
HOSTILE = 'T "1" <°C> & \\n\n ü'


def tank(interpolation: str, name: str = "pump", feedthrough: float = 0.0) -> StateTwin:
    return StateTwin(
        (State("upper", "m", 0.4, 0.0, 2.0), State("lower", "m", 0.2, 0.0, 2.0)),
        lambda x, u: (x.lower, x.upper + feedthrough * u[0]),
        rt.Channels((name,), ("V",)),
        rt.Channels(("lower level", "upper"), ("m", "m")),
        2.0,
        derivative=lambda x, u, p: (
            u[0] - p.drain * x.upper,
            p.drain * x.upper - p.leak * x.lower,
        ),
        parameters=(
            Parameter("drain", "1/s", 0.05, 10.0, 0.8),
            Parameter("leak", "1/s", 0, 3, 0.5),
            Parameter("dead", "s", 0.0, 3.0, 0.7),
        ),
        delays={name: "dead"},
        interpolation=interpolation,
    )


def commanded(count: int, seed: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(0, 2, (count, STEPS // 6, 1)), 6, axis=1)


@pytest.fixture(scope="module", params=["hold", "linear"])
def corrected(request: pytest.FixtureRequest) -> DynamicsTwin:
    twin = tank(request.param)
    made = twin.simulate(commanded(6, 0), seed=0, parameters={"drain": 1.1})
    noise = 0.02 * np.random.default_rng(1).normal(size=made.observed.shape)
    real = made.replace(observed=made.observed + noise)
    fitted = fit_dynamics(twin, real, Dynamics(Library(0, (), False))).twin
    assert fitted.factor.shape[1] > 0
    return fitted


def simulated(path: Path, commands: np.ndarray, period: float, **start: object) -> np.ndarray:
    """Outputs (T, ...) of the FMU after 0, 1, 2 ... steps."""
    times = np.arange(len(commands)) * period
    name = next(each.name for each in description(path).modelVariables if each.causality == "input")
    signals = np.array(
        list(zip(times, commands[:, 0], strict=True)), [("time", float), (name, float)]
    )
    return fmpy.simulate_fmu(
        str(path),
        stop_time=times[-1],
        step_size=period,
        output_interval=period,
        input=hold(signals, period),
        start_values=start,
        record_events=False,
    )


def hold(signals: np.ndarray, period: float) -> np.ndarray:
    """Input signals as steps: fmpy interpolates otherwise."""
    held = np.repeat(signals, 2)[:-1]
    held["time"][1::2] = held["time"][2::2]
    return held


def description(path: Path):
    return fmpy.read_model_description(str(path), validate=True)


def behind(outputs: np.ndarray, twin: DynamicsTwin) -> np.ndarray:
    """Outputs (T, d) as an FMU shows them."""
    if twin.equations.interpolation == "linear":
        return np.concatenate([outputs[:1], outputs[:-1]])
    return outputs


def drawn(seed: int, count: int) -> np.ndarray:
    """The standard Gaussian numbers of the FMU."""
    with np.errstate(over="ignore"):
        x = np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        x = x + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return ndtri(((x >> np.uint64(11)).astype(float) + 0.5) / 2.0**53)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_it_has_the_distribution_and_the_draws_of_the_twin(
    corrected: DynamicsTwin, version: str, tmp_path: Path
) -> None:
    constant = np.array([0.0, 0.05])
    corrected = replace(corrected, widening=np.array([1.3, 0.8]), constant=constant)
    made = export_fmu(corrected, tmp_path / "tank.fmu", version=version)
    u, period = commanded(1, 5), 1 / corrected.rate
    assert made.delay == (period if corrected.equations.interpolation == "linear" else 0)
    found = simulated(made.path, u[0], period, noise=True, seed=7)
    steps, theta = corrected.equations.steps(), corrected.values[None]
    nominal, _ = steps.run(u, theta)
    spread = nominal[0].std(axis=0)
    outputs = corrected.outputs.names
    mean = np.stack([found[f"{name}.mean"] for name in outputs], axis=1)
    np.testing.assert_allclose(mean / spread, behind(nominal[0], corrected) / spread, atol=1e-9)

    by_all = steps.sensitivities(u, theta)[1][0]
    variance = corrected.simulation.noise_variance(u)[0] + ((by_all @ corrected.factor) ** 2).sum(
        axis=2
    )
    starts = by_all[:, :, -2:] * corrected.start_deviation
    deviation = np.sqrt(variance + (starts**2).sum(axis=2))
    scale = np.where(constant > 0, constant / deviation, corrected.widening)
    half = 1.6448536269514722 * scale * deviation
    for suffix, sign in (("q05", -1), ("q95", 1)):
        own = np.stack([found[f"{name}.{suffix}"] for name in outputs], axis=1)
        expected = behind(nominal[0] + sign * half, corrected)
        np.testing.assert_allclose(own / spread, expected / spread, atol=1e-8)

    width = corrected.factor.shape[1]
    numbers = drawn(7, width + 2 + 2 + (STEPS - 1) * 4)
    moves = corrected.factor @ numbers[:width]
    moves[-2:] += corrected.start_deviation * numbers[width : width + 2]
    rest = numbers[width + 2 :]
    errors = np.concatenate([rest[None, :2], rest[2:].reshape(-1, 4)[:, 2:]])
    kicks = np.zeros((1, STEPS, 2))
    kicks[0, :-1] = rest[2:].reshape(-1, 4)[:, :2]
    kicks *= np.sqrt(corrected.free_process)
    kicked = steps.run(u, theta, kicks)[0][0] + np.sqrt(corrected.noise) * errors
    expected = nominal[0] + scale * (kicked - nominal[0] + by_all @ moves)
    sampled = np.stack([found[name] for name in outputs], axis=1)
    np.testing.assert_allclose(sampled / spread, behind(expected, corrected) / spread, atol=1e-5)


def test_parameters_faults_and_starts_are_those_of_the_twin(
    corrected: DynamicsTwin, tmp_path: Path
) -> None:
    path = export_fmu(corrected, tmp_path / "tank.fmu").path
    u, period = commanded(1, 6), 1 / corrected.rate
    plain = simulated(path, u[0], period)
    np.testing.assert_array_equal(plain["upper"], plain["upper.mean"])
    value = dict(zip(corrected.equations.names, corrected.values, strict=True))["drain"]
    leaking = corrected.simulate(u, faults=[ParameterShift("drain", size=0.3)], seed=0)
    moved = simulated(path, u[0], period, drain=value + 0.3)
    theta = corrected.values[None].copy()
    theta[0, corrected.equations.names.index("drain")] += 0.3
    expected = corrected.equations.steps().run(u, theta)[0][0]
    assert leaking.observed.shape == (1, STEPS, 2)
    np.testing.assert_allclose(moved["upper"], behind(expected, corrected)[:, 1], atol=1e-9)
    gain = simulated(path, u[0], period, **{"fault.gain.pump": -0.5, "fault.bias.upper": 0.25})
    half = corrected.equations.steps().run(0.5 * u, corrected.values[None])[0][0]
    np.testing.assert_allclose(gain["upper"], behind(half, corrected)[:, 1] + 0.25, atol=1e-9)
    started = simulated(path, u[0], period, **{"start.upper": 1.5})
    assert started["upper"][0] == 1.5


def test_the_same_seed_draws_the_same_and_another_does_not(
    corrected: DynamicsTwin, tmp_path: Path
) -> None:
    path, again = (export_fmu(corrected, tmp_path / name).path for name in ("a.fmu", "b.fmu"))
    assert path.read_bytes() != b""
    u, period = commanded(1, 7), 1 / corrected.rate
    one, two, other = (
        simulated(each, u[0], period, noise=True, seed=seed)["upper"]
        for each, seed in ((path, 1), (again, 1), (path, 2))
    )
    np.testing.assert_array_equal(one, two)
    assert np.abs(one - other).max() > 0


def test_the_same_twin_gives_the_same_bytes(corrected: DynamicsTwin, tmp_path: Path) -> None:
    parts = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        path = export_fmu(corrected, tmp_path / folder / "t.fmu", compiled=False).path
        parts.append(path.read_bytes())
    assert parts[0] == parts[1]


def test_it_reports_states_and_commands_outside_the_calibration(
    corrected: DynamicsTwin, tmp_path: Path
) -> None:
    path = export_fmu(corrected, tmp_path / "twin.fmu").path
    pump = next(each for each in description(path).modelVariables if each.name == "pump")
    low, high = corrected.domain.low[-1], corrected.domain.high[-1]
    assert (float(pump.min), float(pump.max), float(pump.nominal)) == (low, high, high)
    commands = commanded(1, 9)[0].clip(low, high)
    within = simulated(path, commands, 0.5)
    assert not within["outside_training"].any()
    for factor in (1.04, 1.5):
        beyond = np.full_like(commands, factor * high)
        found = simulated(path, beyond, 0.5)["outside_training"]
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            corrected.simulate(beyond[None], seed=0)
        assert found.any() == bool(warned)
        assert found[-1]


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_names_may_be_anything(version: str, tmp_path: Path) -> None:
    twin = tank("hold", HOSTILE)
    path = export_fmu(twin, tmp_path / "1 tänk-.fmu", version=version).path
    found = description(path)
    assert not fmpy.validation.validate_fmu(str(path))
    assert [each.name for each in found.modelVariables if each.causality == "input"] == [
        'T "1" <°C> & \\n ü'
    ]
    u = commanded(1, 8)
    simulated_ = simulated(path, u[0], 0.5)
    expected = twin.simulate(u, seed=0).nominal[0]
    np.testing.assert_allclose(simulated_["upper"], expected[:, 1], atol=1e-6)


def test_what_cannot_be_exported_is_refused(corrected: DynamicsTwin, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="splines"):
        export_fmu(tank("spline"), tmp_path / "t.fmu")
    with pytest.raises(InputError, match=r"ends in \.fmu"):
        export_fmu(corrected, tmp_path / "t.zip")
    with pytest.raises(InputError, match="version"):
        export_fmu(corrected, tmp_path / "t.fmu", version="1.0")
    with pytest.raises(InputError, match="fit_state_surrogate"):
        export_fmu(rt.cases.armpi().twin, tmp_path / "t.fmu")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_right_twin_is_exported_with_the_bands_of_its_noise(tmp_path: Path) -> None:
    """What `fit` saves where there is nothing to correct: identified parameters and noise."""
    twin = tank("hold")
    made = twin.simulate(commanded(4, 0), seed=0, parameters={"drain": 1.1, "leak": 0.6})
    noise = np.random.default_rng(1).normal(size=made.observed.shape) * [0.02, 0.05]
    real = made.replace(observed=made.observed + noise, labels=["Healthy"] * 4)
    fitted = rt.fit(twin, real, rt.Choice(method="parameters", compare=False), seed=0).twin
    fitted.save(tmp_path / "model")
    path = export_fmu(rt.load_twin(tmp_path / "model"), tmp_path / "tank.fmu").path
    u = commanded(1, 5)
    found = simulated(path, u[0], 1 / twin.rate, noise=True, seed=3)
    nominal = fitted.surrogate.predict(u)[0]
    for i, (name, deviation) in enumerate(zip(twin.outputs.names, (0.02, 0.05), strict=True)):
        np.testing.assert_allclose(found[f"{name}.mean"], nominal[:, i], atol=1e-5)
        width = found[f"{name}.q95"] - found[f"{name}.q05"]
        np.testing.assert_allclose(width, 3.29 * deviation, rtol=0.25)
        assert np.std(found[name] - nominal[:, i]) == pytest.approx(deviation, rel=0.35)


def test_the_command_line_exports_a_saved_twin(
    corrected: DynamicsTwin, call, tmp_path: Path
) -> None:
    corrected.save(tmp_path / "model")
    out = tmp_path / "tank.fmu"
    code, printed, err = call("export", "fmu", tmp_path / "model", "--out", out, "--json")
    assert code == 0, err
    assert '"lower level.q95"' in printed
    assert description(out).fmiVersion == "2.0"
    code, _, err = call("export", "fmu", tmp_path, "--out", tmp_path / "no.fmu")
    assert (code, "corrected model" in err) == (2, True), err
    assert not (tmp_path / "no.fmu").exists()


@pytest.mark.slow
def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = "".join(python_of("export", "The corrected twin in your tool"))
    names: dict = {}
    exec(compile(code, "docs/export.md", "exec"), names)
    found = names["found"]
    assert (found["outflow.q05"] < found["outflow.mean"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_its_source_code_is_clean_and_is_compiled_elsewhere(
    corrected: DynamicsTwin, version: str, tmp_path: Path
) -> None:
    path = export_fmu(corrected, tmp_path / "tank.fmu", version=version, compiled=False).path
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    command = next(iter(compilers()))
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined", "-g")
    driver = Path(__file__).with_name(f"drive_fmi{version[0]}.c")
    token = description(path).guid
    subprocess.run(
        [*command, *strict, f'-DTOKEN_GIVEN="{token}"', f"-I{tmp_path / 'sources'}", str(driver),
         str(tmp_path / "sources" / "tank.c"), "-o", str(tmp_path / "driver"), "-lm"],
        check=True,
    )  # fmt: skip
    done = subprocess.run([str(tmp_path / "driver")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    (build,) = description(path).buildConfigurations
    (sources,) = build.sourceFileSets
    assert sources.language in (None, "C99")
    library = tmp_path / f"tank{fmpy.sharedLibraryExtension}"
    subprocess.run(
        [*command, "-std=c99", "-fPIC", "-shared", "-o", str(library),
         *(str(tmp_path / "sources" / each) for each in sources.sourceFiles), "-lm"],
        check=True,
    )  # fmt: skip
    folder = fmpy.platform if version == "2.0" else fmpy.platform_tuple
    with zipfile.ZipFile(path, "a") as archive:
        archive.write(library, f"binaries/{folder}/{library.name}")
    found = simulated(path, commanded(1, 5)[0], 1 / corrected.rate)
    assert np.isfinite(found["upper"]).all()


@pytest.mark.parametrize(("count"), [pytest.param(10_000, marks=pytest.mark.long), 20])
def test_instances_are_independent_and_their_state_is_kept(
    corrected: DynamicsTwin, tmp_path: Path, count: int
) -> None:
    path = export_fmu(corrected, tmp_path / "tank.fmu").path
    folder, found = fmpy.extract(str(path)), description(path)
    reference = {each.name: each.valueReference for each in found.modelVariables}
    slaves = []
    for name in ("a", "b"):
        slave = fmpy.instantiate_fmu(folder, found, "CoSimulation")
        slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.setBoolean([reference["noise"]], [True])
        slave.setInteger([reference["seed"]], [1 if name == "a" else 2])
        slave.exitInitializationMode()
        slaves.append(slave)
    period = 1 / corrected.rate

    def step(slave, k: int) -> float:
        slave.setReal([reference["pump"]], [1.0])
        slave.doStep(k * period, period)
        return slave.getReal([reference["upper"]])[0]

    first = [[step(slave, k) for slave in slaves] for k in range(3)]
    assert first[-1][0] != first[-1][1]
    state = slaves[0].getFMUState()
    stored = slaves[0].serializeFMUState(state)
    after = [step(slaves[0], k) for k in range(3, 6)]
    slaves[0].setFMUState(state)
    assert [step(slaves[0], k) for k in range(3, 6)] == after
    slaves[0].freeFMUState(state)
    again = slaves[1].deserializeFMUState(stored)
    slaves[1].setFMUState(again)
    assert [step(slaves[1], k) for k in range(3, 6)] == after
    slaves[1].freeFMUState(again)
    for _ in range(count):
        slaves[0].reset()
        slaves[0].setupExperiment(startTime=0.0)
        slaves[0].enterInitializationMode()
        slaves[0].exitInitializationMode()
        value = step(slaves[0], 0)
    assert np.isfinite(value)
    for slave in slaves:
        slave.terminate()
        slave.freeInstance()
