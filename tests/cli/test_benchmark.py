"""The benchmark: what it computes from times, and what the command prints."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import retwin as rt
from retwin.cli import benchmark as bench
from retwin.cli.benchmark import Benchmark, Timing, generating, median_seconds, memory_bandwidth
from retwin.nets.training import Training

BY_HAND = Benchmark(
    count=1000,
    generation={"twin": Timing("twin", 50.0, 0.1), "corrected": Timing("corrected", 10.0)},
    learning={
        "twin_data": Timing("data", 5.0),
        "surrogate": Timing("surrogate", 20.0),
        "residual": Timing("residual", 3.0),
        "residual_command": Timing("another", 100.0),
        "classifier": Timing("classifier", 100.0),
    },
    machine={},
)


def test_ratios_and_break_even_follow_from_the_times() -> None:
    assert BY_HAND.ratio("twin") == 5.0
    assert BY_HAND.paper_ratio == pytest.approx(30600 / 270)
    # 28 s once, 40 ms gained with every trajectory.
    assert BY_HAND.pays_from == pytest.approx(700)
    slow = Benchmark(
        1, {"twin": Timing("", 1.0), "corrected": Timing("", 2.0)}, BY_HAND.learning, {}
    )
    assert slow.pays_from == float("inf")
    figures = BY_HAND.about()
    assert figures["generation"]["twin"] == {
        "what": "twin",
        "seconds": 50.0,
        "share": 0.1,
        "paper": None,
        "ratio": 5.0,
    }


class Clock:
    """Time that passes only where a test says so: what a machine really takes is no number."""

    def __init__(self) -> None:
        self.now = 0.0

    def pass_by(self, seconds: float) -> None:
        self.now += seconds

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(bench, "timed", partial(bench.timed, clock=made))
    return made


def test_training_is_extrapolated_from_few_epochs(clock: Clock) -> None:
    asked: list[int] = []

    def fit(how: Training) -> str:
        asked.append(how.max_epochs)
        clock.pass_by(0.3 + 0.1 * how.max_epochs)
        return "model"

    model, timed = bench._trained(fit, Training(max_epochs=20), "net")
    assert (model, asked) == ("model", [1, 3])
    assert timed.seconds == pytest.approx(0.3 + 0.1 * 20)
    assert timed.share == 0.15


class Counted:
    """A twin that takes ten milliseconds for each trajectory."""

    def __init__(self, twin: rt.Twin, clock: Clock) -> None:
        self.twin, self.clock, self.made = twin, clock, []
        self.inputs, self.outputs, self.rate = twin.inputs, twin.outputs, twin.rate

    def simulate(self, commands, **options):
        self.made.append(len(commands))
        self.clock.pass_by(0.01 * len(commands))
        return self.twin.simulate(commands, **options)


def test_fewer_are_made_and_scaled_up(case: rt.Case, clock: Clock) -> None:
    twin = Counted(rt.twins.get("armpi-kinematic"), clock)
    seconds, share = generating(twin, case, 90, share=0.25, repeats=2)
    assert twin.made == [18, 18]
    assert share == 0.2
    assert seconds == pytest.approx(0.9)


def test_seconds_are_the_median(clock: Clock) -> None:
    pauses = iter([0.0, 0.2, 0.1])
    assert median_seconds(lambda: clock.pass_by(next(pauses)), 3) == pytest.approx(0.1)


def test_memory_is_written_at_a_possible_rate() -> None:
    assert 1e8 < memory_bandwidth() < 1e12


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    words = ["bench", "--n", "18", "--repeats", "1", "--json", "--out", tmp_path / "a.json"]
    done = subprocess.run(
        [sys.executable, "-m", "retwin", *words], check=True, capture_output=True, text=True
    )
    figures = json.loads(done.stdout)
    assert figures == json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert figures["trajectories"] == 18
    ways = figures["generation"]
    assert list(ways) == [
        "twin",
        "twin_default",
        "corrected",
        "corrected_command",
        "surrogate",
        "closed_form",
        "memory",
    ]
    for way in ways.values():
        assert way["seconds"] > 0
        assert way["ratio"] == pytest.approx(way["seconds"] / ways["corrected"]["seconds"])
    assert (ways["twin"]["paper"], ways["corrected"]["paper"]) == (30600, 270)
    assert all(each["seconds"] > 0 for each in figures["learning"].values())
    assert figures["machine"]["retwin"] == rt.__version__
    assert figures["machine"]["cores"] >= 1
