from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.diagnosis.trained.features import Features, class_order


def ramp(count: int, onset: int, length: int, steps: int = 400) -> rt.Trajectories:
    """One actuator from 0 to 1 whose output follows without delay, with an offset of 0.1."""
    commands = np.clip((np.arange(steps) - onset) / length, 0, 1)[None, :, None]
    commands = np.repeat(commands, count, axis=0)
    return rt.Trajectories(commands, nominal=2 * commands, observed=2 * commands + 0.1, rate=100.0)


def test_every_phase_of_the_sensor_is_sampled() -> None:
    given = ramp(2, onset=40, length=80)
    features = Features.at(given, 10.0)
    assert (features.stride, features.width) == (10, 2)
    phases = features.phases(given)
    assert phases.shape == (2, 10, 40, 2)
    np.testing.assert_array_equal(phases[:, 0], features(given))
    np.testing.assert_allclose(phases[:, 7, :, 0], given.nominal[:, 7::10, 0], rtol=1e-6)
    np.testing.assert_allclose(phases[..., 1], 0.1, rtol=1e-5)


@pytest.mark.parametrize(
    ("rate", "steps", "kept"),
    [(1e4, 5000, 100), (25.0, 250, 125), (0.01, 60, 60), (100.0, 1000, 100)],
)
def test_the_default_rate_follows_from_the_trajectories(rate: float, steps: int, kept: int) -> None:
    """Of half a second of a motor at 10 kHz, 10 Hz would keep five samples."""
    values = np.zeros((1, steps, 1))
    record = rt.Trajectories(values, values, values, rate=rate)
    assert Features.at(record)(record).shape == (1, kept, 2)
    with pytest.raises(rt.InputError, match="at least two of the"):
        Features.at(record, rate / steps)


def test_a_sample_beyond_the_end_is_the_last_one() -> None:
    given = ramp(1, onset=40, length=80, steps=395)
    assert Features.at(given, 10.0).phases(given)[0, 9, -1, 0] == given.nominal[0, -1, 0]


def test_the_start_is_hidden_until_the_first_motion_has_settled() -> None:
    given = ramp(1, onset=40, length=85)
    features = Features.at(given, 10.0, hide_start=True)(given)[0].numpy()
    # The ramp ends at 125. Two sensor periods later, at 145, nothing is hidden: the next is at 150.
    assert (features[:15, 1] == 0).all()
    np.testing.assert_allclose(features[15:, 1], 0.1, rtol=1e-5)
    assert (features[:, 0] == 2).all()


def test_features_do_not_depend_on_what_is_hidden() -> None:
    given = ramp(3, onset=40, length=80)
    rng = np.random.default_rng(0)
    nominal, observed = given.nominal.copy(), given.observed.copy()
    nominal[:, :140] += rng.normal(size=(3, 1, 1))
    observed[:, :140] += rng.normal(size=(3, 140, 1))
    changed = given.replace(nominal=nominal, observed=observed)
    shown, hidden = Features.at(given, 10.0), Features.at(given, 10.0, hide_start=True)
    assert not np.array_equal(shown(changed), shown(given))
    np.testing.assert_array_equal(hidden(changed), hidden(given))
    np.testing.assert_array_equal(hidden.phases(changed), hidden.phases(given))


def test_each_trajectory_has_a_start_of_its_own() -> None:
    first, second = ramp(1, onset=10, length=60), ramp(1, onset=200, length=60)
    both = rt.Trajectories.concatenate([first, second])
    features = Features.at(both, 10.0, hide_start=True)
    assert [int((row[:, 1] == 0).sum()) for row in features(both)] == [9, 28]
    np.testing.assert_array_equal(features(both)[1:], features(second))


def test_without_a_segment_everything_is_hidden() -> None:
    still = ramp(2, onset=1000, length=60)
    assert (Features.at(still, 10.0, hide_start=True)(still)[..., 1] == 0).all()


def test_hiding_the_start_needs_commands() -> None:
    given = ramp(2, onset=40, length=80)
    without = given.replace(commands=np.zeros((2, 400, 0)), inputs=None)
    assert Features.at(without, 10.0)(without).shape == (2, 40, 2)
    with pytest.raises(rt.InputError, match=r"trajectories\.commands: .*recover them"):
        Features.at(without, 10.0, hide_start=True)(without)


def test_one_class_is_refused_in_plain_words() -> None:
    given = ramp(2, onset=40, length=80).replace(labels=np.array(["Healthy"] * 2))
    with pytest.raises(rt.InputError, match=r"got labels \['Healthy'\]"):
        class_order(given, ("Healthy", "Stuck"))
