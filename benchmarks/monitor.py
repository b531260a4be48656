"""Run lengths to a false alarm, and delays, of the live monitor on simulated healthy streams.

A thousand streams per scenario, each with a predictive model and ranks of its own, estimated from
its first 500 samples. The average run length (ARL) that is promised is 1000 samples; streams are
watched for 20 000 samples and count as that if they raise no alarm by then, so that the mean is too
small rather than too large. The scenarios are a disturbance with Gaussian innovations, with
autocorrelation 0.98, with Student's t innovations of 3 degrees of freedom, rounded to multiples of
1/16, 1 and 4, with a tenth of the samples missing at random, and all together. Innovations have
unit variance; all sizes are in their standard deviations.

Delays are from a change at sample 101 until the alarm, at most 400, of streams without an alarm
before it (0 where there are none): the innovations shift by 2 (the contract), or the output does.
An offset of an output whose disturbance has autocorrelation 0.98 is one innovation of 2 and then
0.04: no detector that knows the disturbance sees more, and one that does not has false alarms.

Two models: the same with the mean evidence of two filters that follow the output, one within two
samples and one within two hundred, as those of `fit_monitor` do.

Beside it, on the same streams: two-sided CUSUM (k = 0.5, and h = 5.75 for an ARL of 1000 by
Siegmund's approximation) on standardised residuals and after whitening by the lag-one
autocorrelation, with the mean, scale and autocorrelation of the same 500 samples; an alarm at every
sample, and never one.

Targets: lower 99 % bound of the mean run length at least 1000 with an estimated model; mean at most
5000 with a known one; median delay of 2 sigma at most 25. Published figures: one-sided CUSUM with
k = 0.5, h = 5 has run lengths of 930 and 10.4 after a shift by 1 (NIST/SEMATECH e-Handbook,
6.3.2.3.1), and Shiryaev-Roberts A / 0.5604 with threshold A (Pollak, Annals of Statistics 15).

`benchmarks/monitor.py STREAMS` runs fewer.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from record import record
from scipy.signal import lfilter

from retwin.monitor import (
    Detector,
    Location,
    Slack,
    Validity,
    fit_disturbance,
    fit_scores,
    resolution,
)
from retwin.monitor.detect.predictors import agreeing

STREAMS = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
CALIBRATION, ARL, CENSORED = 500, 1000.0, 20_000
CHANGE, WATCHED = 100, 400
WARM_UP, CHUNK = 1000, 500
GAINS = (0.5, 0.005)
"""With which two models follow the output; their evidence is averaged."""
CUSUM_K, CUSUM_H = 0.5, 5.75
SCENARIOS: dict[str, dict[str, float]] = {
    "Gaussian": {},
    "autocorrelation 0.98": {"pole": 0.98},
    "t3": {"freedom": 3},
    "rounded to 1/16": {"quantum": 1 / 16},
    "rounded to 1": {"quantum": 1},
    "0.98, rounded to 4": {"pole": 0.98, "quantum": 4},
    "10 % missing": {"missing": 0.1},
    "all, rounded to 1/16": {"pole": 0.98, "freedom": 3, "quantum": 1 / 16, "missing": 0.1},
    "all, rounded to 1": {"pole": 0.98, "freedom": 3, "quantum": 1, "missing": 0.1},
}
Run = Callable[[NDArray], NDArray]


def simulated(
    seed: int,
    samples: int,
    *,
    pole: float = 0.0,
    freedom: float = np.inf,
    quantum: float = 0.0,
    missing: float = 0.0,
) -> Callable[[float, float], NDArray]:
    """Outputs (STREAMS, samples), by shifts of innovations and of outputs from CHANGE on."""
    rng = np.random.default_rng(seed)
    shape = STREAMS, samples + WARM_UP
    heavy = np.isfinite(freedom)
    noise = rng.standard_t(freedom, shape) if heavy else rng.normal(size=shape)
    noise /= np.sqrt(freedom / (freedom - 2)) if heavy else 1.0
    lost = rng.random((STREAMS, samples)) < missing

    def made(innovation: float, offset: float) -> NDArray:
        after = np.arange(shape[1]) >= WARM_UP + CALIBRATION + CHANGE
        output = lfilter([1], [1, -pole], noise + innovation * after, axis=1) + offset * after
        output = output[:, WARM_UP:]
        if quantum:
            output = np.round(output / quantum) * quantum
        return np.where(lost, np.nan, output)

    return made


def first_alarms(alarms: NDArray, ends: int) -> NDArray:
    """The number of the first sample with an alarm, or `ends`."""
    return np.where(alarms.any(axis=1), alarms.argmax(axis=1) + 1, ends)


def innovations(output: NDArray, level: NDArray, gains: tuple[float, ...]) -> NDArray:
    """Errors (models * streams, T) of filters that follow outputs with gains, from levels on.

    Shapes: output (streams, T), level (models, streams), which changes.
    """
    gain = np.array(gains)[:, None]
    errors = np.empty((*level.shape, output.shape[1]))
    for t, value in enumerate(output.T):
        errors[..., t] = value - level
        level += gain * np.nan_to_num(errors[..., t])
    return errors.reshape(-1, output.shape[1])


def monitor(healthy: NDArray, gains: tuple[float, ...] = (0.0,)) -> tuple[Run, dict[str, float]]:
    """The monitor with the slack that its calibration needs.

    Its evidence is the mean over models that follow outputs with these gains; 0 does not.
    """
    began = time.process_time()
    last = np.zeros((len(gains), len(healthy)))
    known = innovations(healthy, last, gains)
    model = fit_disturbance(known)
    quantum = np.tile(resolution(healthy)[:, None], (len(gains), 1))
    scores = fit_scores(model.held_out, quantum / model.deviation)
    slacks = scores.slack(model.parameters)
    slacks = agreeing(slacks, *scores.score(model.held_out, quantum / model.deviation))
    detector = Detector(slacks)
    seconds = time.process_time() - began
    at_start, _, _ = model.run(model.start(), known)

    def run(output: NDArray) -> NDArray:
        predictor, state, alarms = at_start, detector.start(len(known)), []
        level = last.copy()
        for first in range(0, output.shape[1], CHUNK):
            part = innovations(output[:, first : first + CHUNK], level, gains)
            predictor, errors, deviation = model.run(predictor, part)
            state, evidence = detector.run(state, *scores.score(errors, quantum / deviation))
            alarms.append(evidence.reshape(len(gains), *output.shape[:1], -1).mean(axis=0) >= ARL)
        return first_alarms(np.concatenate(alarms, axis=1), output.shape[1])

    return run, {
        "kappa (median)": float(np.median([each.kappa for each in slacks])),
        "shift (median)": float(np.median([each.shift for each in slacks])),
        "seconds of the fit": seconds,
    }


def cusum(healthy: NDArray, whitened: bool) -> Run:
    """Two-sided CUSUM on standardised residuals, or on those whitened by a lag-one model."""
    mean = np.nanmean(healthy, axis=1, keepdims=True)
    centred = healthy - mean
    products = np.nanmean(centred[:, 1:] * centred[:, :-1], axis=1, keepdims=True)
    pole = products / np.nanmean(centred**2, axis=1, keepdims=True) if whitened else 0.0

    def errors(output: NDArray) -> NDArray:
        output = output - mean
        return output[:, 1:] - pole * output[:, :-1] if whitened else output

    scale = np.nanstd(errors(healthy), axis=1, keepdims=True)

    def run(output: NDArray) -> NDArray:
        scores = errors(np.concatenate([healthy[:, -1:], output], axis=1) if whitened else output)
        both = np.zeros((2, len(output)))
        reached = np.full(len(output), output.shape[1])
        for t, score in enumerate(np.nan_to_num(scores / scale).T):
            both = np.maximum(both + np.outer([1, -1], score) - CUSUM_K, 0)
            hit = (both.max(axis=0) >= CUSUM_H) & (reached == output.shape[1])
            reached[hit] = t + 1
        return reached

    return run


def figures(run: Run, again: Run, healthy: NDArray, shifted: list[NDArray]) -> dict[str, float]:
    """Mean run length with its lower 99 % bound, the share of censored ones, and delays."""
    began = time.process_time()
    length = run(healthy)
    seconds = time.process_time() - began
    mean, deviation = length.mean(), length.std(ddof=1) / np.sqrt(len(length))
    made = {
        "mean run length": float(mean),
        "lower 99 % bound": float(mean - 2.326 * deviation),
        "without alarm": float(np.mean(length >= CENSORED)),
    }
    for name, output in zip(("innovations", "output"), shifted, strict=True):
        delay = again(output) - CHANGE
        made[f"delay, 2 in {name}"] = float(np.median(delay[delay > 0])) if any(delay > 0) else 0.0
    return {**made, "seconds": seconds}


def published() -> dict[str, dict[str, float]]:
    """Run lengths with known distributions, and what the literature gives."""
    rng = np.random.default_rng(7)
    one = ((Location(1.0),),)
    rows = {}
    for name, detector, threshold, shift, figure in (
        ("CUSUM, h = 5, no shift", Detector(kind="cusum", alternatives=one), np.exp(5), 0, 930),
        ("CUSUM, h = 5, shift by 1", Detector(kind="cusum", alternatives=one), np.exp(5), 1, 10.4),
        ("Shiryaev-Roberts, A = 560.4", Detector(alternatives=one), 560.4, 0, 1000),
        ("all alternatives, known model", Detector(), ARL, 0, 5 * ARL),
        ("all, known model, shift by 2", Detector(), ARL, 2, 25),
    ):
        samples = CENSORED if shift == 0 else 500
        state, reached = detector.start(STREAMS), np.full(STREAMS, samples)
        for first in range(0, samples, CHUNK):
            state, evidence = detector.run(state, rng.normal(shift, 1, (STREAMS, CHUNK)))
            new = first_alarms(evidence >= threshold, CHUNK + 1)
            reached = np.where((reached == samples) & (new <= CHUNK), first + new, reached)
        rows[name] = {
            "mean": float(reached.mean()),
            "standard error": float(reached.std() / np.sqrt(STREAMS)),
            "median": float(np.median(reached)),
            "published, or limit": figure,
        }
    return rows


def voided() -> dict[str, dict[str, float]]:
    """Samples until the promise is void, with no alarm counted, at an ARL of a month at 1/3 Hz."""
    rng, arl, samples = np.random.default_rng(8), 876_600.0, 5000
    streams = min(STREAMS, 300)
    detector = Detector(Slack.of_calibration(CALIBRATION, parameters=3))
    test = Validity(detector, arl)
    rows = {}
    for name, scale, shift in (
        ("healthy", 1.0, 0.0),
        ("scale 2", 2.0, 0.0),
        ("scale 1.5", 1.5, 0.0),
        ("scale 0.5", 0.5, 0.0),
        ("shift 0.5", 1.0, 0.5),
    ):
        scores = rng.normal(shift, scale, (streams, samples))
        _, evidence = test.run(test.start(streams), np.zeros(scores.shape, bool), scores)
        until = first_alarms(evidence >= 1 / test.alpha, samples)
        _, found = detector.run(detector.start(streams), scores)
        rows[name] = {
            "void": float((until < samples).mean()),
            "median samples until void": float(np.median(until)),
            "median samples until alarm": float(np.median(first_alarms(found >= arl, samples))),
        }
    # A machine whose scale is twice as large alarms again after each reset.
    state, tested = detector.start(streams), test.start(streams)
    until = np.full(streams, samples)
    for t in range(samples):
        scores = rng.normal(0, 2, streams)
        state, evidence = detector.step(state, scores)
        alarm = evidence >= arl
        tested, _ = test.step(tested, alarm, scores)
        state = detector.reset(state, alarm)
        until = np.where(test.void(tested) & (until == samples), t + 1, until)
    rows["scale 2, reset after alarms"] = {
        "void": float((until < samples).mean()),
        "median samples until void": float(np.median(until)),
        "median samples until alarm": rows["scale 2"]["median samples until alarm"],
    }
    return rows


def main() -> None:
    rows, details = {}, {}
    for number, (name, scenario) in enumerate(SCENARIOS.items()):
        whole = simulated(number, CALIBRATION + CENSORED, **scenario)(0.0, 0.0)
        changed = simulated(100 + number, CALIBRATION + CHANGE + WATCHED, **scenario)
        calibration = whole[:, :CALIBRATION]
        # The changed streams are calibrated on their own first samples.
        own = changed(0.0, 0.0)[:, :CALIBRATION]
        shifted = [changed(*each)[:, CALIBRATION:] for each in ((2.0, 0.0), (0.0, 2.0))]
        healthy = whole[:, CALIBRATION:]
        made, details[name] = monitor(calibration)
        for what, run, again in (
            ("monitor", made, monitor(own)[0]),
            ("two models", monitor(calibration, GAINS)[0], monitor(own, GAINS)[0]),
            ("CUSUM on residuals", cusum(calibration, False), cusum(own, False)),
            ("CUSUM after AR(1)", cusum(calibration, True), cusum(own, True)),
        ):
            rows[f"{name}: {what}"] = figures(run, again, healthy, shifted)
    for what, length, delay in (
        ("always an alarm", 1.0, 1.0),
        ("never one", float(CENSORED), float(WATCHED)),
    ):
        rows[what] = {
            "mean run length": length,
            "lower 99 % bound": length,
            "without alarm": float(length == CENSORED),
            "delay, 2 in innovations": delay,
            "delay, 2 in output": delay,
            "seconds": 0.0,
        }
    record("monitor", f"{STREAMS} streams, promised ARL {ARL:g}, censored at {CENSORED}", rows)
    record("monitor models", "Slack, and seconds of processor time", details)
    record("monitor published", "Run lengths of known distributions", published())
    record("monitor void", "Samples until the promise is void", voided())


if __name__ == "__main__":
    main()
