"""The promise with everything estimated: run lengths and delays of simulated machines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from retwin.monitor import Detector, fit_disturbance, fit_scores, resolution

STREAMS, CALIBRATION, ARL, SAMPLES = 200, 500, 200.0, 4000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pole", "freedom", "step", "missing"),
    [(0.0, 3, 0.0, 0.0), (0.98, 100, 4.0, 0.0), (0.98, 3, 1 / 16, 0.1)],
)
def test_mean_run_length_is_as_promised_and_a_shift_is_found(
    pole: float, freedom: float, step: float, missing: float
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.standard_t(freedom, (STREAMS, 500 + CALIBRATION + SAMPLES))
    noise /= np.sqrt(freedom / (freedom - 2))
    noise[:, -100:] += 2.0
    output = lfilter([1], [1, -pole], noise, axis=1)[:, 500:]
    output = np.round(output / step) * step if step else output
    output[rng.random(output.shape) < missing] = np.nan

    model = fit_disturbance(output[:, :CALIBRATION], max_order=2, folds=2)
    width = resolution(output[:, :CALIBRATION])[:, None]
    scores = fit_scores(model.held_out, width / model.deviation)
    detector = Detector(scores.slack(model.parameters))
    _, errors, deviation = model.run(model.start(), output)
    low, high = (each[:, CALIBRATION:] for each in scores.score(errors, width / deviation))
    healthy = slice(0, SAMPLES - 100)
    _, evidence = detector.run(detector.start(STREAMS), low[:, healthy], high[:, healthy])
    alarms = evidence >= ARL
    lengths = np.where(alarms.any(axis=1), alarms.argmax(axis=1) + 1, SAMPLES - 100)
    assert lengths.mean() - 2.33 * lengths.std() / np.sqrt(STREAMS) >= ARL
    after = slice(SAMPLES - 100, SAMPLES)
    _, evidence = detector.run(detector.start(STREAMS), low[:, after], high[:, after])
    alarms = evidence >= ARL
    delays = np.where(alarms.any(axis=1), alarms.argmax(axis=1) + 1, 100)
    assert np.median(delays) <= (60 if step > 1 else 25)
