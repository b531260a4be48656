"""A new calibration from the last quiet hours that are stored, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from leaking_tank import TANK, recorded
from typer.testing import CliRunner

import retwin as rt
from retwin.cli.monitor import app
from retwin.errors import InputError
from retwin.monitor import Live, Monitor, Registry, Samples, Store, fit_monitor, recalibrate
from retwin.update import Dynamics, Library, fit_dynamics

SECOND, BEGIN = 10**9, 1_700_000_000 * 10**9


def shifted(seed: int, steps: int, part: slice) -> rt.Trajectories:
    """A record whose sensor is off by 0.2 m in a part of it."""
    made = recorded(seed, steps=steps)
    observed = made.observed.copy()
    observed[:, part] += 0.2
    return made.replace(observed=observed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    twin = fit_dynamics(TANK, recorded(0), Dynamics(Library(0, (), False))).twin
    made = tmp_path_factory.mktemp("monitor") / "watch"
    fit_monitor(twin, recorded(1, steps=800), "1 per day").save(made)
    return made


def watched(place: Path, folder: Path, record: rt.Trajectories) -> Store:
    store = Store(place)
    registry = Registry(store, "tank")
    registry.promote(registry.propose(folder, "first").number)
    live = Live(store)
    live.add("a", "tank")
    rows = np.concatenate([record.commands[0], record.observed[0]], axis=1).astype(float)
    live.submit([Samples("a", BEGIN + SECOND * np.arange(len(rows)), rows)])
    return store


@pytest.mark.slow
def test_quiet_hours_make_a_version_in_the_shadow(tmp_path: Path, folder: Path) -> None:
    with watched(tmp_path / "s", folder, shifted(5, 1600, slice(600, 700))) as store:
        assert list(store.log("end"))
        version = recalibrate(store, "a")
        assert (version.number, version.state) == (2, "shadow")
        made = Monitor.load(Registry(store, "tank").folder(2))
        assert made.arl == 86_400
        counted = sum(made.tried.samples.values())
        assert 1000 < counted < 1500  # without the event, and what is before it
        assert Registry(store, "tank").active.number == 1  # type: ignore[union-attr]


def test_too_short_a_quiet_time_is_refused(tmp_path: Path, folder: Path) -> None:
    with watched(tmp_path / "s", folder, recorded(5, steps=300)) as store:
        with pytest.raises(InputError, match="at least 320 s outside of events"):
            recalibrate(store, "a")
        with pytest.raises(InputError, match="one of a"):
            recalibrate(store, "b")


@pytest.mark.slow
def test_two_parts_that_can_be_compared_are_enough(tmp_path: Path, folder: Path) -> None:
    for samples, enough in ((319, False), (320, True)):
        record = recorded(5, steps=340)[:].between(0.0, float(samples))
        with watched(tmp_path / str(samples), folder, record) as store:
            if enough:
                assert recalibrate(store, "a").state == "shadow"
            else:
                with pytest.raises(InputError, match="at least 320 s"):
                    recalibrate(store, "a")


@pytest.mark.slow
def test_an_event_that_lasts_needs_the_word_that_it_is_normal(tmp_path: Path, folder: Path) -> None:
    store = watched(tmp_path / "s", folder, shifted(5, 1600, slice(600, None)))
    with store, pytest.raises(InputError, match="new normal") as error:
        recalibrate(store, "a")
    # What is known of the event is stated where somebody has to decide what it is.
    assert "an event that lasts: a: ALARM" in str(error.value)
    assert "level, higher than predicted (2023-11-14T22:23:2" in str(error.value)
    refused = CliRunner().invoke(app, ["recalibrate", str(tmp_path / "s"), "--asset=a"])
    assert isinstance(refused.exception, InputError)
    done = CliRunner().invoke(
        app, ["recalibrate", str(tmp_path / "s"), "--asset", "a", "--new-normal", "Ada"]
    )
    assert done.exit_code == 0, done.output
    with Store(tmp_path / "s", read_only=True) as store:
        assert Registry(store, "tank").versions()[1].reason.endswith("a new normal as Ada says")
        made = Monitor.load(Registry(store, "tank").folder(2))
        assert 800 < sum(made.tried.samples.values()) <= 1000  # those since the change alone
