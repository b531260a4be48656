from __future__ import annotations

import numpy as np
import pytest

from retwin import ActuatorBias, InputError, Segments, Stuck
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_response

RATE = 50.0


@pytest.fixture
def commands() -> np.ndarray:
    time = np.arange(400)
    first = np.clip((time - 20) / 60, 0, 1) * 100
    second = np.clip((time - 220) / 80, 0, 1) * -30
    still = np.zeros(400)
    return np.stack([first + second, still], axis=-1)[None].astype(float)


def test_stuck_holds_the_response_from_its_onset(commands: np.ndarray) -> None:
    held = frozen_response(commands, [Stuck(0, onset=0.98)], rate=RATE)
    np.testing.assert_array_equal(held[0, :50], commands[0, :50])
    assert (held[0, 49:, 0] == commands[0, 49, 0]).all()
    np.testing.assert_array_equal(held[0, :, 1], commands[0, :, 1])


def test_stuck_onset_is_drawn_in_its_range(commands: np.ndarray) -> None:
    segments = Segments.from_commands(np.repeat(commands, 200, axis=0))
    drawn = draw_faults([Stuck(0, onset=(0.2, 0.6))] * 200, segments, seed=0, rate=RATE)
    onsets = {fault.onset for fault in drawn}
    assert onsets == {sample / RATE for sample in range(10, 31)}


@pytest.mark.parametrize("rate", [0.25, 48.0, 100.0, 8192.0])
def test_every_sample_can_be_an_onset(commands: np.ndarray, rate: float) -> None:
    """A drawn onset is a whole sample, at any rate."""
    fault = Stuck(0, onset=(0.0, 399 / rate))
    rows = Segments.from_commands(np.repeat(commands, 4000, axis=0))
    drawn = draw_faults([fault] * 4000, rows, seed=0, rate=rate)
    rising = np.arange(400.0)[:, None]
    held = {int(each.response(rising, rate)[-1, 0]) for each in set(drawn)}
    assert held == set(range(400))


def test_an_onset_after_the_end_is_refused(commands: np.ndarray) -> None:
    """Such a trajectory would be labelled with a fault that never acts."""
    segments = Segments.from_commands(commands)
    for onset in (70.0, (8.0, 9.0)):
        with pytest.raises(InputError, match=r"onset: .* lasts 8 s, got .*, in seconds and not"):
            draw_faults([Stuck(0, onset)], segments, seed=0, rate=RATE)
    (drawn,) = draw_faults([Stuck(0, (7.98, 70.0))], segments, seed=0, rate=RATE)
    assert drawn == Stuck(0, 7.98)


def test_the_bias_builds_up_along_the_ramp_and_is_kept(commands: np.ndarray) -> None:
    segments = Segments.from_commands(commands)
    fault = ActuatorBias(0, bias=(20.0, -10.0))
    bias = faulty_commands(commands, [fault], segments, rate=RATE)[0, :, 0] - commands[0, :, 0]
    assert (bias[:21] == 0).all(), "the actuator starts at rest, without bias"
    np.testing.assert_allclose(bias[50], 10.0, atol=1e-6)
    np.testing.assert_allclose(bias[81:220], 20.0, atol=1e-6)
    np.testing.assert_allclose(bias[260], 5.0, atol=1e-6)
    np.testing.assert_allclose(bias[301:], -10.0, atol=1e-6)


def test_an_actuator_without_a_new_command_is_biased_too(commands: np.ndarray) -> None:
    segments = Segments.from_commands(commands)
    biased = faulty_commands(commands, [ActuatorBias(1, bias=(20.0, -10.0))], segments, rate=RATE)
    np.testing.assert_allclose(biased[0, 81:220, 1], 20.0)
    np.testing.assert_allclose(biased[0, 301:, 1], -10.0)


def test_drawn_biases_follow_the_protocol(commands: np.ndarray) -> None:
    segments = Segments.from_commands(np.repeat(commands, 500, axis=0))
    drawn = draw_faults([ActuatorBias(0, (10.0, 50.0))] * 500, segments, seed=1, rate=RATE)
    biases = np.array([fault.bias for fault in drawn])
    assert biases.shape == (500, 2), "one bias per segment"
    assert (np.abs(biases) >= 10).all()
    assert (np.abs(biases) <= 50).all()
    assert abs((biases > 0).mean() - 0.5) < 0.05
    assert abs(np.abs(biases).mean() - 30) < 1.5


def test_the_same_seed_gives_the_same_severity(commands: np.ndarray) -> None:
    segments = Segments.from_commands(commands)
    one, two, other = (
        draw_faults([ActuatorBias(0, (10.0, 50.0))], segments, seed=seed, rate=RATE)
        for seed in (3, 3, 4)
    )
    assert one == two
    assert one != other


def test_an_open_severity_is_refused(commands: np.ndarray) -> None:
    segments = Segments.from_commands(commands)
    with pytest.raises(InputError, match="draw_faults first"):
        faulty_commands(commands, [ActuatorBias(0, (10.0, 50.0))], segments, rate=RATE)
    with pytest.raises(InputError, match="draw_faults first"):
        frozen_response(commands, [Stuck(0, onset=(0.0, 0.2))], rate=RATE)
    with pytest.raises(InputError, match="one per trajectory"):
        draw_faults([None, None], segments, seed=0, rate=RATE)


@pytest.mark.parametrize("onset", [(8, 3), -1, (-2, 3), np.inf, np.nan, (1, 2, 3), None, (), "12"])
def test_an_onset_that_cannot_be_is_refused(onset: object) -> None:
    with pytest.raises(
        InputError, match=r"onset: expected a time in s from 0 on, or a pair \(low, "
    ):
        Stuck(0, onset)  # type: ignore[arg-type]


def test_onsets_may_be_numpys_and_listed() -> None:
    assert Stuck(0, np.float32(0.5)) == Stuck(0, 0.5)
    assert Stuck(0, [np.int64(3), 8.5]) == Stuck(0, (3, 8.5))
    assert type(Stuck(0, 3).onset) is float


@pytest.mark.parametrize("size", [(50.0, 10.0), (-5.0, 5.0), (0.0, np.inf), (np.nan, 1.0), (1.0,)])
def test_sizes_that_cannot_be_are_refused(size: tuple) -> None:
    with pytest.raises(InputError, match="size: expected a pair"):
        ActuatorBias(0, size=size)


def test_a_bias_needs_a_size_or_is_given() -> None:
    """What is small for one machine breaks another: no size suits all units."""
    with pytest.raises(InputError, match=r"size: expected a pair .* in command units, .* got none"):
        ActuatorBias(0)
    assert ActuatorBias(0, bias=(1.0,)).bias == (1.0,)
