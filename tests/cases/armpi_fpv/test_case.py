from __future__ import annotations

import os
import pickle
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.armpi_fpv.case import ArmSampler
from retwin.cases.armpi_fpv.twin import KINEMATIC

DATA = os.environ.get("RETWIN_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="RETWIN_DATA names the folder of the real data")


def test_classes_stand_in_their_fixed_order(case: rt.Case) -> None:
    motors = range(1, 5)
    assert case.classes == (
        "Healthy",
        *(f"Motor_{i}_Stuck" for i in motors),
        *(f"Motor_{i}_Steady_state_error" for i in motors),
    )


def test_commands_are_drawn_as_published() -> None:
    sampler = ArmSampler()
    commands = sampler.sample(400, rng=np.random.default_rng(0)).astype(float)
    assert commands.shape == (400, 1000, 4)
    assert (commands[:, 0] == 500).all()
    held = commands[:, 199::200]
    np.testing.assert_array_equal(held, np.round(held), "targets lie on the grid")
    angle = np.abs(500 - held) * 0.24
    assert angle[..., 0].max() <= 80.13
    assert angle[..., 1:].max() <= 50.13
    assert angle[..., 0].max() > 75
    # Rounding the target to the grid can add half a unit over the shortest ramp.
    assert (np.abs(np.diff(commands, axis=1)) * 0.24).max() <= 2.72 + 0.12 / 59
    lengths = rt.Segments.from_commands(commands)
    longest = (lengths.settle - lengths.start)[lengths.valid]
    assert {round(x) for x in longest} <= {60, 80, 100}


def test_the_case_can_be_sent_to_another_process(case: rt.Case) -> None:
    again = pickle.loads(pickle.dumps(case))
    own, sent = (rt.generate(c.twin, c, per_class=1, seed=0) for c in (case, again))
    assert own.observed.tobytes() == sent.observed.tobytes()


@pytest.mark.slow
def test_random_onset_is_an_option(case: rt.Case) -> None:
    made = rt.generate(case.twin, case.with_random_onset(), per_class=60, seed=0)
    stuck = made.with_label("Motor_1_Stuck").observed
    # The yaw stands still from the onset on: its tangent no longer changes.
    yaw = np.arctan2(stuck[..., 0], -stuck[..., 1])
    moving = np.abs(np.diff(yaw, axis=1)) > 1e-4
    last = moving.shape[1] - moving[:, ::-1].argmax(axis=1)
    assert np.std(last) > 100


def test_cases_are_found_by_name() -> None:
    assert rt.cases.get("armpi").name == "armpi"
    assert rt.cases.get("retwin.cases.armpi_fpv.case:armpi").name == "armpi"
    for name in (
        "nothing",
        "retwin.cases.armpi_fpv.case:nothing",
        "no.such.module:case",
        "os:path",
    ):
        with pytest.raises(
            rt.InputError,
            match=r"armpi, tanks, tanks_overflow, silverbox, incubator, a file \*.toml, or package",
        ):
            rt.cases.get(name)


def real_set() -> rt.Trajectories:
    """The real trajectories at hand, public file or development set."""
    assert DATA
    names = ("real_a.mat", "my_dataset_test.mat")
    file = next(f for name in names if (f := Path(DATA) / "armpi" / name).exists())
    return rt.load(file, case=rt.cases.armpi())


@pytest.mark.slow
@needs_data
@pytest.mark.real_data
def test_the_real_robot_is_as_described() -> None:
    """The discrepancies of REFERENCE, found through the whole chain."""
    real = real_set()
    assert not real.emulated
    assert real.known_labels == set(rt.cases.armpi().classes)
    case = rt.cases.armpi()
    twin = rt.generate(case.twin, case, per_class=60, seed=0)
    ibg = rt.fit_surrogate(
        twin, seed=0, training=rt.Training(max_epochs=8, batch_size=256, learning_rate=1e-2)
    )
    healthy = real.with_label("Healthy")
    context, found = rt.infer_discrepancy(ibg, healthy, rt.DelayOffset())
    assert context.segments.valid.sum() >= 4 * len(healthy)
    delay = found.z[..., 0][found.identified[..., 0]]
    assert 3 < delay.median() < 6
    assert (delay > 1).float().mean() > 0.9
    size = found.z[..., 1:].norm(dim=-1)[found.identified[..., 1]]
    assert 0.001 < size.median() < 0.012


@pytest.mark.slow
@needs_data
@pytest.mark.real_data
def test_a_corrected_twin_is_nearer_to_the_real_robot() -> None:
    """Healthy trajectories never seen: the corrected twin's residuals are of the right size."""
    real = real_set()
    case = rt.cases.armpi()
    calibration, test = real.split(0.5, seed=0)
    twin = rt.generate(case.twin, case, per_class=60, seed=0)
    ibg = rt.fit_surrogate(
        twin, seed=0, training=rt.Training(max_epochs=8, batch_size=256, learning_rate=1e-2)
    )
    updated = rt.CorrectedTwin(ibg, rt.fit_residual(ibg, calibration, seed=0))
    held_out = test.with_label("Healthy")
    made = updated.simulate(held_out.commands, seed=0)
    plain = case.twin.simulate(held_out.commands, seed=0)

    def spread(trajectories: rt.Trajectories) -> float:
        return float(np.median(np.linalg.norm(trajectories.residual, axis=2)))

    target = spread(held_out)
    assert abs(np.log(spread(made) / target)) < abs(np.log(spread(plain) / target)) / 2


def test_encoder_noise_moves_all_joints_of_all_trajectories_alike(case: rt.Case) -> None:
    """It does not depend on labels, which it would reveal."""
    made = rt.generate(case.twin, case, per_class=3, seed=0)
    noisy = case.encoder_noise(made, 1.0, seed=0)
    moved = np.abs(noisy.observed - made.observed).max(axis=2)
    assert (moved[:, :50].max(axis=1) > 1e-4).all()
    assert (moved[:, 50:].max(axis=1) > 1e-4).all()
    # One unit of four motors at the arm's full reach.
    assert moved.max() <= 4 * 0.26 * np.deg2rad(0.24) * 1.1
    unlabelled = made.replace(labels=np.full(len(made), ""))
    again = case.encoder_noise(unlabelled, 1.0, seed=0)
    np.testing.assert_array_equal(again.observed, noisy.observed)
    # The change at a sample of the sensor is one of the steps of the four motors.
    i, t = 4, 200
    slopes = np.stack(
        [
            (KINEMATIC.position(made.commands[i] + step) - KINEMATIC.position(made.commands[i]))[t]
            for step in np.eye(4)
        ]
    )
    steps = np.array(list(product((-1, 0, 1), repeat=4)))
    change = (noisy.observed - made.observed)[i, t]
    assert np.linalg.norm(steps @ slopes - change, axis=1).min() < 2e-5
