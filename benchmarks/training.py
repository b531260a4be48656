"""Time of training a classifier on 3600 trajectories, and the effect of savings on its score.

The classifiers are the paper's LSTM and the CNN: seconds per epoch of 3600 trajectories of 1000
samples x 6 features, measured on fewer and scaled; and macro-F1 on held-out simulated trajectories,
mean and standard deviation over 3 seeds. Compared are a plain loop at the full rate,
`fit_diagnoser`, and `fit_diagnoser` with larger batches. All data are simulated. With the argument
`full`, macro-F1 is computed at the full rate too (hours).
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
import torch
from record import record
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

import retwin as rt
from retwin.diagnosis.trained.features import Features, class_index
from retwin.diagnosis.trained.network import training_for
from retwin.nets.networks import Network

SEEDS = 3
WHOLE = 3600
"""Trajectories for which times are given."""
TRAINED = 100
"""Training trajectories per class, of which a fifth selects the best epoch."""
TESTED = 50
"""Test trajectories per class."""
BRIEF = 20
"""Trajectories per class that are timed at the full rate."""


def plain_epoch(data: rt.Trajectories, network: Network, threads: int) -> float:
    """Time in s of an epoch of a plain loop: example by example, Adam, `threads` threads."""
    order = tuple(sorted(data.known_labels))
    features = Features.at(data, data.rate)(data)
    loader = DataLoader(
        TensorDataset(features, class_index(data, order)),
        batch_size=training_for(network).batch_size,
        shuffle=True,
        generator=torch.Generator().manual_seed(0),
    )
    module = network.build(features.shape[2], len(order))
    optimiser = torch.optim.Adam(module.parameters())
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    started = time.perf_counter()
    for inputs, labels in loader:
        optimiser.zero_grad()
        nn.functional.cross_entropy(module(inputs), labels).backward()
        optimiser.step()
    took = time.perf_counter() - started
    torch.set_num_threads(before)
    return took


def epoch(data: rt.Trajectories, network: Network, rate: float, how: rt.Training) -> float:
    """Time in s of an epoch of `fit_diagnoser`: the difference between three epochs and one."""
    times = []
    for epochs in (1, 1, 3):
        started = time.perf_counter()
        rt.fit_diagnoser(data, network, seed=0, rate=rate, training=replace(how, max_epochs=epochs))
        times.append(time.perf_counter() - started)
    return (times[2] - times[1]) / 2


def macro_f1(
    data: rt.Trajectories,
    test: rt.Trajectories,
    network: Network,
    rate: float,
    how: rt.Training,
) -> tuple[float, float]:
    """Mean and standard deviation over seeds."""
    scores = [
        rt.evaluate(
            rt.fit_diagnoser(data, network, seed=seed, rate=rate, training=how), test
        ).macro_f1
        for seed in range(SEEDS)
    ]
    return float(np.mean(scores)), float(np.std(scores, ddof=1))


def main(full: bool) -> None:
    case = rt.cases.armpi()
    data = rt.generate(case.emulator, case, per_class=TRAINED, seed=0)
    test = rt.generate(case.emulator, case, per_class=TESTED, seed=1)
    brief = rt.generate(case.emulator, case, per_class=BRIEF, seed=2)
    slow, fast = data.rate, case.sensor_rate
    seconds: dict[str, float] = {}
    scores: dict[str, dict[str, float]] = {}
    for name, network in (("LSTM", rt.LSTMClassifier()), ("CNN", rt.CNN())):
        default = training_for(network)
        larger = replace(
            default,
            batch_size=4 * default.batch_size,
            learning_rate=2 * default.learning_rate,
        )
        for threads in (2, 1):
            took = plain_epoch(brief, network, threads)
            what = f"{name}, {slow:g} Hz, plain loop, {threads} threads"
            seconds[what] = WHOLE / len(brief) * took
        for what, rate, how in (
            ("fit_diagnoser", slow, default),
            ("fit_diagnoser", fast, default),
            ("fit_diagnoser, 4 times the batch size, twice the learning rate", fast, larger),
        ):
            timed = brief if rate == slow else data
            what = f"{name}, {rate:g} Hz, {what}"
            seconds[what] = WHOLE / len(timed) * epoch(timed, network, rate, how)
            if full or rate == fast:
                mean, deviation = macro_f1(data, test, network, rate, how)
                scores[what] = {"macro-F1": mean, "over seeds": deviation}
    record("training", f"seconds per epoch of {WHOLE} trajectories", seconds)
    record(
        "training_accuracy",
        f"{len(data)} training trajectories, {len(test)} test trajectories",
        scores,
    )


if __name__ == "__main__":
    main("full" in sys.argv[1:])
