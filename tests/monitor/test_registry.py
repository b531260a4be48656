"""Versions of a twin: only the allowed steps, each in the log, and the same bytes back."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.monitor import Decision, FalseAlarmTest, Registry, Store, decide, verify
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics

RNG = np.random.default_rng(0)
KEPT = FalseAlarmTest(alarms=0, samples=10_000, run_length=1e5)
OLD = np.abs(RNG.normal(1.0, 0.1, size=1000))
CASES = {
    "better": (OLD, OLD - 0.1 + RNG.normal(0, 0.1, 1000), KEPT, True),
    "equal": (OLD, OLD + RNG.normal(0, 0.1, 1000), KEPT, False),
    "the same": (OLD, OLD, KEPT, False),
    "worse": (OLD, OLD + 0.1, KEPT, False),
    "alarms": (OLD, OLD - 0.1, dataclasses.replace(KEPT, alarms=1, samples=2000), False),
    "records": (OLD.reshape(1, -1)[[0] * 9], OLD[None][[0] * 9] - 0.1, KEPT, True),
}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "store") as opened:
        yield opened


def model(folder: Path, text: str = "weights") -> Path:
    """A folder as of a saved model; the registry does not read what its files hold."""
    (folder / "inner").mkdir(parents=True)
    (folder / "model.json").write_text("{}")
    (folder / "inner" / "weights.safetensors").write_text(text)
    return folder


def better() -> Decision:
    return decide(*CASES["better"][:3])


def states(registry: Registry) -> list[str]:
    return [each.state for each in registry.versions()]


def test_the_life_of_versions(store: Store, tmp_path: Path) -> None:
    registry, other = Registry(store), Registry(store, "other")
    for n in range(4):
        proposed = registry.propose(model(tmp_path / str(n), f"weights {n}"), f"reason {n}")
        assert (proposed.number, proposed.state, proposed.reason) == (
            n + 1,
            "proposed",
            f"reason {n}",
        )
    assert registry.active is None
    assert registry.reference is None
    registry.promote(1)
    for number in (2, 3):
        registry.shadow(number)
    assert states(registry) == ["active", "shadow", "shadow", "proposed"]
    assert registry.promote(2, better()).state == "active"
    assert states(registry) == ["retired", "active", "proposed", "proposed"], "compared with 1"
    registry.reject(4, "it was a trial")
    registry.shadow(3)
    registry.promote(3, better())
    assert registry.rollback("alarms").number == 2
    assert registry.rollback().number == 1
    assert states(registry) == ["active", "retired", "retired", "rejected"]
    with pytest.raises(InputError, match="a version that was active before, got 1"):
        registry.rollback()
    for each in (registry.active, registry.reference):
        assert each is not None
        assert (each.number, each.reference) == (1, True)
    assert registry.folder(1).joinpath("inner/weights.safetensors").read_text() == "weights 0"
    assert other.versions() == []
    steps = [entry.data["step"] for entry in store.log("version")]
    assert steps == [
        *["propose"] * 4, "promote", "shadow", "shadow", "promote", "reject", "shadow", "promote",
        "rollback", "rollback",
    ]  # fmt: skip
    promoted = [entry.data for entry in store.log("version")][7]
    assert promoted["evidence"]["low"] == better().low
    assert promoted["evidence"]["false_alarms"]["samples"] == 10_000
    assert verify(store.log(), store.head).ok
    with pytest.raises(InputError, match="one of none"):
        other.shadow(1)


@pytest.mark.parametrize(
    ("state", "allowed"),
    [
        ("proposed", {"shadow", "reject"}),
        ("shadow", {"promote", "reject"}),
        ("active", set()),
        ("retired", set()),
        ("rejected", set()),
    ],
)
def test_only_allowed_steps(store: Store, tmp_path: Path, state: str, allowed: set[str]) -> None:
    registry = Registry(store)
    registry.propose(model(tmp_path / "a"), "first")
    registry.promote(1)
    registry.propose(model(tmp_path / "b", "other"), "second")
    if state in ("shadow", "active", "retired"):
        registry.shadow(2)
    if state in ("active", "retired"):
        registry.promote(2, better())
    if state == "retired":
        registry.rollback()
    if state == "rejected":
        registry.reject(2, "")
    assert registry.versions()[1].state == state
    steps = {
        "shadow": lambda: registry.shadow(2),
        "promote": lambda: registry.promote(2, better()),
        "reject": lambda: registry.reject(2, ""),
    }
    for name in steps.keys() - allowed:
        before = store.head
        with pytest.raises(InputError, match=f"one that is {state}"):
            steps[name]()
        assert store.head == before
    if allowed:
        steps[min(allowed)]()


@pytest.mark.parametrize("name", CASES)
def test_decisions(name: str) -> None:
    old, new, alarms, expected = CASES[name]
    decision = decide(old, new, alarms)
    assert decision.better is expected
    assert decision.low <= decision.difference <= decision.high
    assert decision.difference == pytest.approx(np.mean(old - new))
    assert decide(old, new, alarms) == decision, "of one seed"


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if not case[3]])
def test_promotion_is_refused_with_both_numbers(store: Store, tmp_path: Path, name: str) -> None:
    registry = Registry(store)
    for n in range(2):
        registry.propose(model(tmp_path / str(n), str(n)), "")
    registry.promote(1)
    registry.shadow(2)
    before = store.head
    evidence = decide(*CASES[name][:3])
    with pytest.raises(InputError) as error:
        registry.promote(2, evidence)
    assert f"{evidence.low:.3g} to {evidence.high:.3g}" in str(error.value)
    assert f"{evidence.false_alarms.alarms} alarms in" in str(error.value)
    with pytest.raises(InputError, match="Decision"):
        registry.promote(2)
    assert store.head == before
    assert states(registry) == ["active", "shadow"]


def test_the_interval_excludes_zero_as_rarely_as_it_should() -> None:
    """No difference, autocorrelation 0.9: 2.5 % of promotions would be exact."""
    wrong, rng = 0, np.random.default_rng(3)
    for seed in range(100):
        noise = rng.normal(size=2200)
        for k in range(1, len(noise)):
            noise[k] += 0.9 * noise[k - 1]
        wrong += decide(5 + noise[200:], np.full(2000, 5.0), KEPT, seed=seed).low > 0
    assert wrong <= 9


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (OLD, OLD[:-1], "same samples"),
        (OLD, np.where(np.arange(1000) == 5, np.nan, OLD), "same samples"),
        (OLD, np.where(np.arange(1000) == 5, np.inf, OLD), "finite scores"),
        (OLD[:159], OLD[:159], "at least 160"),
        (np.full(1000, np.nan), np.full(1000, np.nan), "at least 160"),
        (np.zeros((0, 1000)), np.zeros((0, 1000)), "at least 160"),
        (np.zeros((2, 2, 200)), np.zeros((2, 2, 200)), "same samples"),
    ],
    ids=["shape", "missing", "infinite", "few", "nothing", "no record", "dimensions"],
)
def test_scores_that_cannot_be_compared(old: np.ndarray, new: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decide(old, new, KEPT)


@pytest.mark.parametrize("given", [{"alarms": -1}, {"samples": 0}, {"run_length": 0.0}])
def test_impossible_false_alarm_tests(given: dict) -> None:
    with pytest.raises(InputError):
        dataclasses.replace(KEPT, **given)


def test_links_and_devices_are_refused(store: Store, tmp_path: Path) -> None:
    registry = Registry(store)
    secret = tmp_path / "secret"
    secret.write_text("not of the model")
    for n, make in enumerate(
        (
            lambda folder: (folder / "inner" / "link").symlink_to(secret),
            lambda folder: (folder / "more").symlink_to(tmp_path),
            lambda folder: (folder / "nowhere").symlink_to(tmp_path / "nothing"),
            lambda folder: os.mkfifo(folder / "pipe"),
        )
    ):
        make(model(tmp_path / str(n)))
        with pytest.raises(InputError, match="link or a device"):
            registry.propose(tmp_path / str(n), "")
    model(tmp_path / "whole")
    (tmp_path / "as link").symlink_to(tmp_path / "whole")
    (tmp_path / "empty").mkdir()
    for name in ("as link", "empty", "missing", "secret"):
        with pytest.raises(InputError, match="folder of a saved model"):
            registry.propose(tmp_path / name, "")
    assert registry.versions() == []


def test_changed_bytes_are_found(store: Store, tmp_path: Path) -> None:
    registry = Registry(store)
    registry.propose(model(tmp_path / "a"), "")
    registry.propose(model(tmp_path / "b"), "the same bytes, another version")
    registry.promote(1)
    assert registry.folder(1) == registry.folder(2)
    file = registry.folder(1) / "inner" / "weights.safetensors"
    for change in (
        lambda: file.write_text("weightS"),
        lambda: (file.unlink(), file.symlink_to(tmp_path / "a" / "inner" / file.name)),
        lambda: (file.unlink(), file.write_text("weights"), (file.parent / "new").touch()),
    ):
        change()
        with pytest.raises(InputError):
            registry.folder(1)
        with pytest.raises(InputError):
            registry.shadow(2)
    registry.propose(tmp_path / "a", "puts the copy in order")
    assert registry.folder(1)


def test_a_forged_log_names_no_other_folder(store: Store, tmp_path: Path) -> None:
    step = {"twin": "twin", "step": "propose", "version": 1, "digest": "../..", "reason": ""}
    store.commit(entries=[("version", step)])
    with pytest.raises(InputError, match="step of the registry"):
        Registry(store).versions()


@pytest.mark.slow
def test_rollback_gives_the_same_predictions_within_a_second(store: Store, tmp_path: Path) -> None:
    lag = StateTwin(
        (State("x", "m"),),
        lambda x, u: x.x,
        rt.Channels(("u",), ("V",)),
        rt.Channels(("y",), ("m",)),
        20.0,
        derivative=lambda x, u, p: (u.u - p.rate * x.x,),
        parameters=(Parameter("rate", "1/s", 0.1, 20.0, 2.0),),
    )
    commands = np.cumsum(np.random.default_rng(0).normal(size=(2, 120, 1)), axis=1) / 5
    registry = Registry(store)

    def predicted() -> bytes:
        active = registry.active
        assert active is not None
        twin = DynamicsTwin.load(registry.folder(active.number))
        return twin.simulate(commands, seed=5).observed.tobytes()

    seen = []
    for n, rate in enumerate((3.0, 4.0)):
        made = lag.simulate(commands, seed=0, parameters={"rate": rate})
        noise = 1e-3 * np.random.default_rng(1).normal(size=made.observed.shape)
        record = made.replace(observed=made.observed + noise)
        fit_dynamics(lag, record, Dynamics(Library(1, (), False))).twin.save(tmp_path / str(n))
        number = registry.propose(tmp_path / str(n), f"rate {rate}").number
        if n:
            registry.shadow(number)
        registry.promote(number, better() if n else None)
        seen.append(predicted())
    assert seen[0] != seen[1]
    begun = time.process_time()
    registry.rollback("the newer one was wrong")
    again = predicted()
    assert time.process_time() - begun < 1.0
    assert again == seen[0]
