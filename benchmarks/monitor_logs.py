"""Monitors of logs alone, without a twin: events of emulated test beds as labels of their samples.

A test bed has eight sensors at 1 Hz, no commands, and a run of 1000 to 1200 samples. The first 400
calibrate; in the middle of the rest something is wrong, from one sample until another. Sensors have
a common disturbance, and errors of their own that are autocorrelated, rounded, of heavy tails or of
a scale that varies; of some the level drifts, within the calibration and after it. None of this is
what the monitor is fitted as. Kinds of anomalies: a level of one sensor or of four that differs by
3 to 6 standard deviations, twice or three times the noise, sensors that lose what they had in
common, and a sensor that is frozen.

An event is an alarm of all its samples; pooled over test beds, F1 is that of samples, and false and
missed are shares of the healthy and of the anomalous ones. The promise counts as kept before the
anomaly where there is no event and nothing void before it.

`benchmarks/monitor_logs.py BEDS`
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from record import record
from scipy.signal import lfilter

import retwin as rt
from retwin.data.trajectories import Channels
from retwin.monitor import fit_monitor

BEDS = int(sys.argv[1]) if len(sys.argv) > 1 else 60
CALIBRATION, SENSORS = 400, 8
KINDS = ("level of one", "level of four", "variance", "correlation", "frozen")


def test_bed(rng: np.random.Generator, kind: str) -> tuple[rt.Trajectories, NDArray]:
    """A run, and whether something is wrong at its samples."""
    samples = int(rng.integers(1000, 1200))
    begin = int(rng.integers(550, 620))
    end = begin + int(rng.integers(250, 380))
    faulty = (np.arange(samples) >= begin) & (np.arange(samples) < end)
    shape, common = (samples + 300, SENSORS), rng.uniform(0.0, 0.8, SENSORS)
    shared = lfilter([1], [1, -0.7], rng.normal(size=shape[0])) * np.sqrt(1 - 0.7**2)
    noise = np.empty(shape)
    poles = rng.choice([0.0, 0.5, 0.9, 0.97], SENSORS)
    for i, pole in enumerate(poles):
        freedom = rng.choice([3.5, 5.0, 200.0])
        scale = np.exp(0.3 * np.sin(np.arange(shape[0]) / rng.uniform(20, 200)))
        own = rng.standard_t(freedom, shape[0]) / np.sqrt(freedom / (freedom - 2)) * scale
        noise[:, i] = lfilter([1], [1, -pole], own) * np.sqrt(1 - pole**2)
    y = noise * np.sqrt(1 - common**2) + common * shared[:, None]
    y = y[300:]
    chosen = rng.permutation(SENSORS)
    if kind.startswith("level"):
        which = chosen[: 4 if kind.endswith("four") else 1]
        y[np.ix_(faulty, which)] += rng.choice([-1, 1], len(which)) * rng.uniform(3, 6, len(which))
    elif kind == "variance":
        y[np.ix_(faulty, chosen[:3])] *= rng.uniform(2, 3)
    elif kind == "correlation":
        y[faulty] -= (common * shared[300:, None])[faulty]
    else:
        y[np.ix_(faulty, chosen[:1])] = y[begin, chosen[0]]
    drift = np.where(rng.random(SENSORS) < 0.3, rng.normal(size=SENSORS), 0.0)
    y += drift * (np.arange(samples) / 400)[:, None]
    steps = rng.choice([0.0, 0.1, 0.5], SENSORS)
    y = np.where(steps > 0, np.round(y / np.where(steps > 0, steps, 1)) * steps, y)
    y = y * 10 ** rng.uniform(-2, 2, SENSORS) + rng.uniform(-50, 50, SENSORS)
    channels = Channels(tuple(f"sensor {i}" for i in range(SENSORS)), ("1",) * SENSORS)
    made = rt.Trajectories(
        commands=np.zeros((1, samples, 0)),
        nominal=np.zeros((1, *y.shape)),
        observed=y[None],
        rate=1.0,
        ids=np.array([kind]),
        inputs=Channels((), ()),
        outputs=channels,
    )
    return made, faulty


def main() -> None:
    rng = np.random.default_rng(0)
    rows = {}
    counts = {kind: np.zeros(7) for kind in KINDS}
    for number in range(BEDS):
        kind = KINDS[number % len(KINDS)]
        run, faulty = test_bed(rng, kind)
        cut = CALIBRATION / run.rate
        monitor = fit_monitor(None, run.between(0.0, cut))
        watched = monitor.watch(run.between(cut, run.steps / run.rate))
        wrong, event = faulty[CALIBRATION:], watched.event[0]
        begin = int(wrong.argmax())
        confusion = [np.sum(event & wrong), np.sum(event & ~wrong), np.sum(~event & wrong)]
        kept = not event[:begin].any() and not watched.void[0, :begin].any()
        counts[kind] += [*confusion, np.sum(~event & ~wrong), kept, watched.void[0].any(), 1]
    for name, each in (*counts.items(), ("all", sum(counts.values()))):
        hit, false, missed, calm, kept, void, beds = each
        rows[name] = {
            "F1": 2 * hit / (2 * hit + false + missed),
            "false": false / (false + calm),
            "missed": missed / (hit + missed),
            "promise kept before": kept / beds,
            "void": void / beds,
            "beds": int(beds),
        }
    record("monitor logs", "Test beds without a twin", rows)


if __name__ == "__main__":
    main()
