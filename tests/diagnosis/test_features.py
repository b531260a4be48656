from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.diagnosis.features import Features


def ramp(count: int, onset: int, length: int, steps: int = 400) -> rt.Trajectories:
    """One actuator that goes from 0 to 1; the output follows at once, 0.1 too high."""
    commands = np.clip((np.arange(steps) - onset) / length, 0, 1)[None, :, None]
    commands = np.repeat(commands, count, axis=0)
    return rt.Trajectories(commands, nominal=2 * commands, observed=2 * commands + 0.1, rate=100.0)


def test_every_phase_is_a_view() -> None:
    given = ramp(2, onset=40, length=80)
    features = Features.at(given)
    assert (features.stride, features.width) == (10, 2)
    phases = features.phases(given)
    assert phases.shape == (2, 10, 40, 2)
    np.testing.assert_array_equal(phases[:, 0], features(given))
    np.testing.assert_allclose(phases[:, 7, :, 0], given.nominal[:, 7::10, 0], rtol=1e-6)
    np.testing.assert_allclose(phases[..., 1], 0.1, rtol=1e-5)


def test_a_last_reading_beyond_the_end_is_the_last_sample() -> None:
    given = ramp(1, onset=40, length=80, steps=395)
    assert Features.at(given).phases(given)[0, 9, -1, 0] == given.nominal[0, -1, 0]


def test_the_start_is_hidden_until_the_first_movement_rests() -> None:
    given = ramp(1, onset=40, length=85)
    features = Features.at(given, hide_start=True)(given)[0].numpy()
    # The ramp ends at 125; two readings later, at 145, all is shown: first by the one at 150.
    assert (features[:15, 1] == 0).all()
    np.testing.assert_allclose(features[15:, 1], 0.1, rtol=1e-5)
    assert (features[:, 0] == 2).all()


def test_what_is_hidden_cannot_be_seen() -> None:
    given = ramp(3, onset=40, length=80)
    rng = np.random.default_rng(0)
    nominal, observed = given.nominal.copy(), given.observed.copy()
    nominal[:, :140] += rng.normal(size=(3, 1, 1))
    observed[:, :140] += rng.normal(size=(3, 140, 1))
    moved = given.replace(nominal=nominal, observed=observed)
    shown, hidden = Features.at(given), Features.at(given, hide_start=True)
    assert not np.array_equal(shown(moved), shown(given))
    np.testing.assert_array_equal(hidden(moved), hidden(given))
    np.testing.assert_array_equal(hidden.phases(moved), hidden.phases(given))


def test_each_trajectory_has_a_start_of_its_own() -> None:
    early, late = ramp(1, onset=10, length=60), ramp(1, onset=200, length=60)
    both = rt.Trajectories.concatenate([early, late])
    features = Features.at(both, hide_start=True)
    assert [int((row[:, 1] == 0).sum()) for row in features(both)] == [9, 28]
    np.testing.assert_array_equal(features(both)[1:], features(late))


def test_without_a_movement_all_is_start() -> None:
    still = ramp(2, onset=1000, length=60)
    assert (Features.at(still, hide_start=True)(still)[..., 1] == 0).all()


def test_the_real_start_is_told_by_commands() -> None:
    given = ramp(2, onset=40, length=80)
    blind = given.replace(commands=np.zeros((2, 400, 0)), inputs=None)
    assert Features.at(blind)(blind).shape == (2, 40, 2)
    with pytest.raises(rt.InputError, match=r"trajectories\.commands: .*recover them"):
        Features.at(blind, hide_start=True)(blind)
