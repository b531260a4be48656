"""How long does a classifier train on 3600 trajectories, and what does each saving cost?

The paper's LSTM and the CNN: seconds per epoch of 3600 trajectories of 1000 samples x 6 features,
measured on fewer and scaled; and macro-F1 on simulated trajectories that no step saw, mean and
standard deviation over 3 seeds. First a plain loop at the full rate, then what retwin does, then
what one could do besides. All data are simulated, none is real. With the argument `full`, macro-F1
at the full rate too (hours).
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
from retwin.diagnosis.features import Features, class_index
from retwin.diagnosis.network import training_for
from retwin.nets.networks import Network

SEEDS = 3
WHOLE = 3600
"""Trajectories that seconds are told for."""
TRAINED = 100
"""Per class, to learn from; a fifth of them chooses the epoch."""
TESTED = 50
"""Per class, to score on."""
BRIEF = 20
"""Per class, for seconds at the full rate."""


def plain_epoch(data: rt.Trajectories, network: Network, threads: int) -> float:
    """Seconds for an epoch as it is written first: example by example, Adam, so many threads."""
    order = tuple(sorted(data.known_labels))
    features = Features.at(data, data.rate)(data)
    loader = DataLoader(
        TensorDataset(features, class_index(data, order)),
        batch_size=training_for(network).batch,
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
    """Seconds for an epoch of `fit_diagnoser`: the difference between three and one."""
    took = []
    for epochs in (1, 1, 3):
        started = time.perf_counter()
        rt.fit_diagnoser(data, network, seed=0, rate=rate, training=replace(how, epochs=epochs))
        took.append(time.perf_counter() - started)
    return (took[2] - took[1]) / 2


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
        usual = training_for(network)
        larger = replace(usual, batch=4 * usual.batch, rate=2 * usual.rate)
        for threads in (2, 1):
            took = plain_epoch(brief, network, threads)
            what = f"{name}, {slow:g} Hz, plain loop, {threads} threads"
            seconds[what] = WHOLE / len(brief) * took
        for what, rate, how in (
            ("fit_diagnoser", slow, usual),
            ("fit_diagnoser", fast, usual),
            ("fit_diagnoser, 4 times the batch, twice the rate", fast, larger),
        ):
            timed = brief if rate == slow else data
            what = f"{name}, {rate:g} Hz, {what}"
            seconds[what] = WHOLE / len(timed) * epoch(timed, network, rate, how)
            if full or rate == fast:
                mean, deviation = macro_f1(data, test, network, rate, how)
                scores[what] = {"macro-F1": mean, "over seeds": deviation}
    record("training", f"seconds per epoch of {WHOLE} trajectories", seconds)
    record("training_accuracy", f"{len(data)} to learn from, {len(test)} to score on", scores)


if __name__ == "__main__":
    main("full" in sys.argv[1:])
