"""All twins keep the same contract."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fmus import c_fmu

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.testing import TWIN_CHECKS, TwinSubject, check_twin
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.function import FunctionTwin
from retwin.twins.mujoco.twin import MuJoCoTwin
from retwin.twins.workers import keep_workers

Subject = Callable[[pytest.FixtureRequest], TwinSubject]

TANK = rt.Channels(("valve", "heater"), ("1", "W"))
LEVEL = rt.Channels(("level", "temperature"), ("m", "K"))


def ramps(count: int = 3, steps: int = 120) -> np.ndarray:
    """Two commands that move twice, at other times in each trajectory."""
    time = np.arange(steps, dtype=float)[:, None] - np.arange(count)[:, None, None]
    return np.clip(time / 40, 0, 1) * [0.5, 80.0] + np.clip(time / 20 - 3, 0, 1) * [0.25, -30.0]


def tank(commands: np.ndarray) -> np.ndarray:
    """Two first-order lags that meet, (T, 2) or (n, T, 2)."""
    level = np.cumsum(commands[..., :1], axis=-2) / (10 + np.arange(commands.shape[-2])[:, None])
    return np.concatenate([level, 290 + commands[..., 1:] / (1 + level)], axis=-1)


def noisy_tank(commands: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return tank(commands) + rng.normal(0, [0.01, 0.1], commands.shape)


def of_arm(part: Callable[[pytest.FixtureRequest], rt.Twin]) -> Subject:
    """Three short trajectories for a twin of the arm."""

    def subject(request: pytest.FixtureRequest) -> TwinSubject:
        sampler = request.getfixturevalue("case").sampler
        sampler = replace(sampler, movements=2, duration=3.0, period=1.5)
        commands = sampler.sample(3, rng=np.random.default_rng(0))
        faults = (None, rt.Stuck(1, onset=(0.2, 0.8)), rt.ActuatorBias(2, (10.0, 50.0)))
        return TwinSubject(part(request), commands, faults)

    return subject


def of_tank(function: Callable = tank, **settings: Any) -> Subject:
    twin = FunctionTwin(function, TANK, LEVEL, 20.0, **settings)
    return lambda request: TwinSubject(twin, ramps())


def of_crane(**options: Any) -> Subject:
    """A pendulum on a cart, driven by a force and observed by its sensors."""
    path = Path(__file__).with_name("crane.xml")
    twin = MuJoCoTwin.from_file(path, rate=50.0, **options)
    pushes = ramps()[:, :, :1] - 0.4
    faults = (None, rt.ActuatorBias(0, size=(0.5, 1.0)), rt.Stuck(0, onset=0.6))
    return lambda request: TwinSubject(twin, pushes, faults)


@pytest.fixture(scope="module", autouse=True)
def workers() -> Iterator[None]:
    """All checks of a twin share its worker processes, as in `check_twin`."""
    with keep_workers():
        yield


@pytest.fixture(scope="module")
def lag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return c_fmu(tmp_path_factory.mktemp("lag"))


def of_fmu(request: pytest.FixtureRequest) -> TwinSubject:
    """A first-order lag, compiled from C."""
    path = request.getfixturevalue("lag")
    twin = FMUTwin.from_file(path, 20.0, ["u"], ["x"], workers=1)
    return TwinSubject(twin, ramps()[:, :, :1])


TWINS: dict[str, Subject] = {
    "arm": of_arm(lambda request: request.getfixturevalue("case").twin),
    "kinematic arm": of_arm(lambda request: KINEMATIC),
    "emulator": of_arm(lambda request: request.getfixturevalue("case").emulator),
    "surrogate": of_arm(lambda request: request.getfixturevalue("ibg")),
    "corrected": of_arm(lambda request: request.getfixturevalue("updated")),
    "MuJoCo model": of_crane(inputs=("free",)),
    "MuJoCo model with limits": of_crane(inputs=("limited",)),
    "FMU": of_fmu,
    "function": of_tank(),
    "function with limits": of_tank(limits=rt.Limits((0.0, -np.inf), (1.0, 200.0))),
    "function that clips": of_tank(limits=rt.Limits((0.0, 0.0), (1.0, 200.0), outside="clip")),
    "function of one trajectory": of_tank(vectorised=False),
    "function in processes": of_tank(vectorised=False, workers=2),
    "random function": of_tank(noisy_tank, nominal=tank),
    "random function of one trajectory": of_tank(noisy_tank, nominal=tank, vectorised=False),
}


@pytest.fixture(params=TWINS)
def subject(request: pytest.FixtureRequest) -> TwinSubject:
    return TWINS[request.param](request)


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
def test_twin(subject: TwinSubject, check: Callable[[TwinSubject], None]) -> None:
    check(subject)


GOOD = FunctionTwin(tank, TANK, LEVEL, 20.0)
Simulate = Callable[..., rt.Trajectories]


@dataclass(frozen=True)
class Bent:
    """A good twin that something was done to."""

    bend: Callable[..., rt.Trajectories]
    limits: rt.Limits | None = None
    inputs: rt.Channels = TANK
    outputs: rt.Channels = LEVEL
    rate: float = 20.0

    def simulate(self, commands, *, faults=None, seed, progress=None) -> rt.Trajectories:
        return self.bend(GOOD.simulate, commands, faults=faults, seed=seed, progress=progress)


def loses_an_output(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    return made.replace(
        nominal=made.nominal[..., :1],
        observed=made.observed[..., :1],
        mask=None,
        outputs=rt.Channels(("level",), ("m",)),
    )


def rounds_commands(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(np.round(commands, 1), **how)


def has_gaps(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    return made.replace(mask=made.observed > made.observed.min())


def forgets_labels(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(commands, **how).replace(labels=None)


def ignores_the_seed(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    noise = np.random.default_rng().normal(size=made.observed.shape)
    return made.replace(observed=made.observed + noise)


def draws_other_severities(good: Simulate, commands, *, seed: int, **how: Any) -> rt.Trajectories:
    return good(commands, seed=seed + 1, **how)


def has_a_faulty_nominal(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    return made.replace(nominal=made.observed)


def knows_no_faults(good: Simulate, commands, *, faults, **how: Any) -> rt.Trajectories:
    labels = good(commands, faults=faults, **how).labels
    return good(commands, **how).replace(labels=labels)


def shakes_when_others_are_faulty(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    return made.replace(observed=made.observed + np.abs(made.residual).max())


def compares_with_the_others(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    return made.replace(observed=made.observed - made.observed.mean(axis=0))


def spoils_its_argument(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    made = good(commands, **how)
    np.multiply(commands, 0, out=commands, casting="unsafe")
    return made


def keeps_its_argument(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(commands, **how).replace(commands=commands)


def reads_only_doubles(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    scale = 1 if commands.dtype == np.float64 else 1000
    return good(commands / scale, **how)


def runs_for_120_samples(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(np.asarray(commands)[:, :120], **how)


def fills_what_is_short(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    missing = max(0, 2 - np.shape(commands)[1])
    return good(np.pad(commands, ((0, 0), (0, missing), (0, 0))), **how)


def says_it_is_half_done(good: Simulate, commands, *, progress, **how: Any) -> rt.Trajectories:
    made = good(commands, progress=progress, **how)
    if progress is not None:
        progress(0.5)
    return made


def repairs_commands(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(np.nan_to_num(commands), **how)


def repairs_faults(good: Simulate, commands, *, faults, **how: Any) -> rt.Trajectories:
    given = [*(faults or ()), *[None] * len(commands)][: len(commands)]
    return good(commands, faults=given, **how)


def repairs_seeds(good: Simulate, commands, *, seed: Any, **how: Any) -> rt.Trajectories:
    return good(commands, seed=int(abs(seed or 0)), **how)


def good_as_it_is(good: Simulate, commands, **how: Any) -> rt.Trajectories:
    return good(commands, **how)


def seeds_everything(good: Simulate, commands, *, seed: int, **how: Any) -> rt.Trajectories:
    np.random.seed(seed)  # noqa: NPY002
    return good(commands, seed=seed, **how)


ONE = rt.Limits((0.0, 0.0), (1.0, 200.0))
BROKEN: list[tuple[str, Any]] = [
    ("check_protocol", SimpleNamespace(inputs=TANK, outputs=LEVEL, simulate=GOOD.simulate)),
    ("check_result", Bent(loses_an_output)),
    ("check_result", Bent(rounds_commands)),
    ("check_result", Bent(has_gaps)),
    ("check_result", Bent(good_as_it_is, rate=50.0)),
    ("check_labels", Bent(forgets_labels)),
    ("check_seed", Bent(ignores_the_seed)),
    ("check_severities", Bent(draws_other_severities)),
    ("check_nominal", Bent(has_a_faulty_nominal)),
    ("check_faults_act", Bent(knows_no_faults)),
    ("check_faults_act", Bent(shakes_when_others_are_faulty)),
    ("check_batch", Bent(compares_with_the_others)),
    ("check_arguments_kept", Bent(spoils_its_argument)),
    ("check_arguments_kept", Bent(keeps_its_argument)),
    ("check_number_types", Bent(reads_only_doubles)),
    ("check_lengths", Bent(runs_for_120_samples)),
    ("check_too_short", Bent(fills_what_is_short)),
    ("check_progress", Bent(says_it_is_half_done)),
    ("check_bad_commands", Bent(repairs_commands)),
    ("check_bad_faults", Bent(repairs_faults)),
    ("check_bad_seed", Bent(repairs_seeds)),
    ("check_limits", Bent(good_as_it_is, limits=ONE)),
    ("check_limits", Bent(good_as_it_is, limits=replace(ONE, outside="clip"))),
    ("check_global_randomness", Bent(seeds_everything)),
    ("check_pickle", Bent(lambda good, *args, **how: good(*args, **how))),
]


def named(broken: Any) -> str:
    return broken if isinstance(broken, str) else getattr(broken, "bend", type).__name__


@pytest.mark.parametrize(("name", "broken"), BROKEN, ids=named)
def test_a_broken_twin_is_caught(name: str, broken: Any) -> None:
    check = {check.__name__: check for check in TWIN_CHECKS}[name]
    with pytest.raises(AssertionError):
        check(TwinSubject(broken, ramps()))


def test_every_check_can_fail() -> None:
    assert {check.__name__ for check in TWIN_CHECKS} == {name for name, _ in BROKEN}


def test_all_that_is_broken_is_listed() -> None:
    check_twin(GOOD, ramps())
    with pytest.raises(AssertionError) as caught:
        check_twin(Bent(ignores_the_seed), ramps())
    listed = str(caught.value)
    assert listed.startswith(
        "Bent breaks its contract:\n- check_seed: observed: the same seed must"
    )
    assert "- check_severities: " in listed
    with pytest.raises(AssertionError, match="check_protocol: a twin must have inputs"):
        check_twin(SimpleNamespace(inputs=TANK, simulate=None), ramps())


def test_a_twin_need_not_know_stuck_actuators(tmp_path: Path) -> None:
    """A twin whose actuators drive tendons refuses them; its subject has other faults."""
    crane = Path(__file__).with_name("crane.xml").read_text("utf-8")
    tendon = '<tendon><fixed name="cable"><joint joint="rail" coef="1"/></fixed></tendon>'
    model = crane.replace("<actuator>", tendon + "<actuator>").replace(
        'name="free" joint="rail"', 'name="free" tendon="cable"'
    )
    (tmp_path / "tendon.xml").write_text(model, encoding="utf-8")
    twin = MuJoCoTwin.from_file(tmp_path / "tendon.xml", rate=50.0, inputs=("free",))
    pushes = ramps()[:, :, :1] - 0.4
    with pytest.raises(rt.InputError, match="hinge or slide"):
        twin.simulate(pushes, faults=[rt.Stuck(0, 0.1)] * 3, seed=0)
    check_twin(twin, pushes, [None, *[rt.ActuatorBias(0, size=(0.5, 1.0))] * 2])


def test_a_subject_must_be_informative() -> None:
    with pytest.raises(rt.InputError, match="n at least 2 and T at least 8"):
        TwinSubject(GOOD, ramps(1))
    with pytest.raises(rt.InputError, match="some None and some not"):
        TwinSubject(GOOD, ramps(), [None] * 3)
    still = TwinSubject(GOOD, np.ones((2, 20, 2)))
    check = {check.__name__: check for check in TWIN_CHECKS}["check_faults_act"]
    with pytest.raises(AssertionError, match="no fault of the subject changes its commands"):
        check(still)


def test_twins_are_checked_without_torch_or_pytest() -> None:
    code = "import sys, retwin.testing; assert not {'torch', 'pytest'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
