"""E-detectors: published run lengths, hostile and missing samples, and equal bytes."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.monitor import Detector, DetectorState, Location, Scale, Slack

ONE_SIGMA = ((Location(1.0),),)


def run_lengths(detector: Detector, threshold: float, scores: NDArray) -> NDArray:
    """Samples until the evidence reaches a threshold; those of the record if it does not."""
    _, evidence = detector.run(detector.start(len(scores)), scores)
    hit = evidence >= threshold
    return np.where(hit.any(axis=1), hit.argmax(axis=1) + 1, scores.shape[1])


def same(first: DetectorState, second: DetectorState) -> bool:
    return all(getattr(first, n).tobytes() == getattr(second, n).tobytes() for n in vars(first))


@pytest.mark.parametrize(("shift", "published"), [(0.0, 336.0), (1.0, 8.38)])
def test_cusum_has_the_published_run_lengths(shift: float, published: float) -> None:
    # k = 0.5, h = 4, one-sided: NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.3.1.
    scores = np.random.default_rng(0).normal(shift, 1, (1000, 100 if shift else 2500))
    found = run_lengths(Detector(kind="cusum", alternatives=ONE_SIGMA), np.exp(4), scores)
    assert abs(found.mean() - published) < 3.5 * found.std() / np.sqrt(len(found))


def test_shiryaev_roberts_has_the_published_run_length() -> None:
    # A / zeta with zeta = 0.5604 for one standard deviation: Pollak, Average run lengths of an
    # optimal method of detecting a change in distribution, Annals of Statistics 15 (1987).
    scores = np.random.default_rng(1).normal(size=(1000, 2500))
    found = run_lengths(Detector(alternatives=ONE_SIGMA), 200, scores)
    assert abs(found.mean() - 200 / 0.5604) < 3.5 * found.std() / np.sqrt(len(found))


def test_an_alarm_until_t_has_a_probability_of_at_most_t_over_the_arl() -> None:
    scores = np.random.default_rng(2).normal(size=(2000, 100))
    found = run_lengths(Detector(), 400, scores)
    for until in (25, 50, 99):
        assert np.mean(found <= until) <= until / 400 + 2 / np.sqrt(2000) * np.sqrt(until / 400)


CHANGES = ["up", "down", "wide", "narrow", "stuck", "frozen", "tails", "dependent"]


@pytest.mark.parametrize("change", CHANGES)
def test_each_change_is_found(change: str) -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(50, 400))
    dependent = np.empty_like(noise)
    last = noise[:, 0]
    for t in range(400):
        last = dependent[:, t] = 0.8 * last + 0.6 * noise[:, t]
    changed = {
        "up": noise + 1.5,
        "down": noise - 1.5,
        "wide": 3 * noise,
        "narrow": noise / 3,
        "stuck": np.zeros_like(noise),
        "frozen": np.linspace(-2.0, 2.0, 50)[:, None] + noise / 50,
        "tails": np.where(rng.random(noise.shape) < 0.15, 5, 0.8) * noise,
        "dependent": dependent,
    }[change]
    found = run_lengths(Detector(Slack(1.25, 0.1)), 1e6, changed)
    assert np.median(found) < (400 if change == "tails" else 150 if change == "dependent" else 60)


@pytest.mark.parametrize("alternative", [Location(1.0), Scale(2.5)])
def test_a_change_that_lasts_is_rarely_over_and_one_that_ended_is_soon(
    alternative: Location | Scale,
) -> None:
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(400, 300))
    detector = Detector(Slack(1.1, 0.1), alternatives=((alternative,),))
    lasts = noise + 1.0 if isinstance(alternative, Location) else 2.5 * noise
    change = np.stack([np.arange(400), np.zeros(400, dtype=int)], axis=1)
    given = np.ones(400), change, np.zeros(400)
    reached = (detector.evidence_of_end(*given, lasts) >= 2000).any(axis=1)
    assert reached.mean() <= 300 / 2000
    assert np.median((detector.evidence_of_end(*given, noise) >= 2000).argmax(axis=1)) < 40


def test_evidence_that_a_change_is_over_does_not_depend_on_how_samples_are_grouped() -> None:
    scores = np.random.default_rng(6).normal(size=(2, 50))
    scores[0, 20:30] = np.nan
    detector, change = Detector(), np.array([[0, 3], [1, 9]])
    whole = detector.evidence_of_end(np.ones(2), change, np.zeros(2), scores)
    state, evidence, parts = detector.start(2), np.ones(2), []
    for part in np.split(scores, [7, 24, 25], axis=1):
        parts.append(detector.evidence_of_end(evidence, change, state.previous, part))
        evidence = parts[-1][:, -1]
        state, _ = detector.run(state, part)
    assert np.concatenate(parts, axis=1).tobytes() == whole.tobytes()
    assert (np.diff(whole[0, 20:30]) == 0).all(), "missing samples are no evidence"


@pytest.mark.parametrize("kind", ["shiryaev_roberts", "cusum"])
def test_bytes_do_not_depend_on_how_samples_are_grouped(kind: str) -> None:
    rng = np.random.default_rng(4)
    slacks = [Slack(1.0 + 0.1 * (i % 3), 0.05 * (i % 2)) for i in range(7)]
    scores = rng.normal(0, 2, (7, 60))
    scores[rng.random(scores.shape) < 0.2] = np.nan
    high = scores + rng.choice([0.0, 0.3, 9.0], scores.shape)
    detector = Detector(slacks, kind=kind)
    whole, evidence = detector.run(detector.start(7), scores, high)
    state, steps = detector.start(7), []
    for t in range(60):
        if t == 30:  # saved and restored
            file = BytesIO()
            np.savez(file, **vars(state))
            file.seek(0)
            state = DetectorState(**np.load(file))
        before = [each.tobytes() for each in vars(state).values()]
        made, found = detector.step(state, scores[:, t], high[:, t])
        assert before == [each.tobytes() for each in vars(state).values()], "was changed"
        state = made
        steps.append(found)
    assert same(whole, state)
    assert np.array(steps).T.tobytes() == evidence.tobytes()
    for i in range(7):
        alone = Detector(slacks[i], kind=kind)
        found = alone.run(alone.start(1), scores[i : i + 1], high[i : i + 1])[1]
        assert found.tobytes() == evidence[i].tobytes()


def test_hostile_samples_are_large_or_missing_and_overflow_nothing() -> None:
    detector = Detector()
    for value in (1e-300, 0.0, -1e300, np.inf, -np.inf, 1e300):
        state, evidence = detector.run(detector.start(2), np.full((2, 2000), value))
        assert np.isfinite(evidence).all()
        assert np.isfinite(state.evidence).all()
        assert np.all(state.evidence > 0)
    assert np.all(evidence[:, -1] > 1e270), "bounded, but not stopped before"
    back, found = detector.run(state, np.random.default_rng(0).normal(size=(2, 3)))
    assert np.isfinite(found).all()
    assert np.isfinite(back.evidence).all()


def test_a_missing_sample_changes_no_evidence_and_is_no_time() -> None:
    scores = np.random.default_rng(5).normal(size=(3, 40))
    with_holes = np.full((3, 80), np.nan)
    with_holes[:, ::2] = scores
    # Without bets on dependence, which need the score just before.
    detector = Detector(alternatives=((Location(1.0), Scale(2.0)),))
    state, evidence = detector.run(detector.start(3), scores)
    other, found = detector.run(detector.start(3), with_holes)
    assert found[:, ::2].tobytes() == evidence.tobytes()
    assert found[:, 1::2].tobytes() == evidence.tobytes()
    assert other.evidence.tobytes() == state.evidence.tobytes()
    everything = np.full((3, 4), np.inf)
    all_ranks, _ = detector.run(state, -everything, everything)
    assert all_ranks.evidence == pytest.approx(state.evidence + 4), "a bet of 1 each"
    empty, nothing = detector.step(detector.start(3), np.full(3, np.nan))
    assert same(empty, detector.start(3))
    assert not nothing.any()


def test_a_reset_begins_anew_where_it_is_wanted() -> None:
    detector = Detector()
    state, _ = detector.run(detector.start(2), np.full((2, 5), 3.0))
    again = detector.reset(state, np.array([True, False]))
    assert not again.evidence[0].any()
    assert again.evidence[1].tobytes() == state.evidence[1].tobytes()


def test_wrong_shapes_and_settings_are_refused() -> None:
    detector = Detector()
    with pytest.raises(InputError, match="scores of 2 streams"):
        detector.run(detector.start(2), np.zeros((3, 4)))
    with pytest.raises(InputError, match="lower ends of intervals"):
        detector.step(detector.start(1), [1.0], [0.5])
    with pytest.raises(InputError, match="kind: expected one of"):
        Detector(kind="ewma")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="streams: expected 2"):
        Detector([Slack(), Slack(1.1)]).start(3)
    with pytest.raises(InputError, match="kappa"):
        Slack(0.5)
