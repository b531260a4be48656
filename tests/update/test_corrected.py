from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt


def test_generated_sets_are_balanced_and_labelled(updated: rt.CorrectedTwin, case: rt.Case) -> None:
    made = rt.generate(updated, case, per_class=3, seed=0)
    assert made.labels.tolist() == [name for name in case.classes for _ in range(3)]
    assert made.commands.dtype == np.float32
    assert np.isfinite(made.observed).all()


def test_same_seed_same_bytes(updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path) -> None:
    for name in ("a", "b"):
        rt.save(rt.generate(updated, case, per_class=20, seed=3), tmp_path / f"{name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    other = rt.generate(updated, case, per_class=20, seed=4)
    assert other.observed.tobytes() != rt.load(tmp_path / "a.npz").observed.tobytes()


def test_sources_share_commands_and_faults(
    ibg: rt.Surrogate, updated: rt.CorrectedTwin, case: rt.Case
) -> None:
    alone = rt.generate(ibg, case, per_class=2, seed=5, onsets=updated.onsets)
    both = rt.generate(updated, case, per_class=2, seed=5)
    np.testing.assert_array_equal(alone.commands, both.commands)
    np.testing.assert_array_equal(alone.nominal, both.nominal)
    # The residual model is all that differs, and it is of the size of millimetres.
    discrepancy = np.linalg.norm(alone.observed - both.observed, axis=2)
    assert 0 < np.median(discrepancy[:, 150:190]) < 0.02


@pytest.mark.slow
def test_healthy_ones_are_distributed_like_the_robot_s(ibg: rt.Surrogate, case: rt.Case) -> None:
    """Median distance from nominal, in steady parts and in motion, within a factor of 1.6.

    Sixty trajectories calibrate. The ratio was 1.02 in steady parts and 0.92 in motion here, and
    1.05 to 1.15 for three other sets; with a start at clusters it was 1.2 to 2.4 in steady parts.
    """
    commands = case.sampler.sample(60, rng=np.random.default_rng(5))
    real = case.emulator.simulate(commands, seed=9)
    updated = rt.CorrectedTwin(ibg, rt.fit_residual(ibg, real, seed=0))
    made = rt.generate(updated, case, per_class=100, seed=6).with_label("Healthy")
    segments = 200 * np.arange(5)[:, None]
    for part in (segments + np.arange(150, 195), segments + np.arange(20, 60)):
        simulated, measured = (
            np.median(np.linalg.norm(t.residual[:, part.ravel()], axis=2)) for t in (made, real)
        )
        assert 1 / 1.6 < simulated / measured < 1.6


def test_onsets_come_from_the_calibration_set(
    ibg: rt.Surrogate, emulated: rt.Trajectories, case: rt.Case
) -> None:
    onsets = np.array([[0.0325, 2.055, 4.11, 6.12, 8.15]])
    made = rt.generate(ibg, case, per_class=1, seed=0, onsets=onsets)
    found = rt.Segments.from_commands(made.commands)
    np.testing.assert_allclose(found.start, np.tile(100 * onsets, (9, 1)), atol=0.05)


def test_saved_and_loaded_generates_the_same(
    updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    updated.save(tmp_path / "twin")
    back = rt.CorrectedTwin.load(tmp_path / "twin")
    assert back.case == "armpi"
    before, after = (rt.generate(t, case, per_class=2, seed=1) for t in (updated, back))
    assert before.observed.tobytes() == after.observed.tobytes()


def test_a_count_below_one_is_refused(updated: rt.CorrectedTwin, case: rt.Case) -> None:
    with pytest.raises(rt.InputError, match="per_class"):
        rt.generate(updated, case, per_class=0, seed=0)
