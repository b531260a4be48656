"""Two studies of the same test trajectories, for instance with two versions of retwin.

`python compare_studies.py BEFORE AFTER`, two folders of studies. For every source of both: macro-F1
and healthy recall, and their differences with 95 % intervals of a paired bootstrap over
trajectories and runs, which are resampled alike in both studies.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from retwin.results import Results, read_results
from retwin.scores.classification import weighted_score

DRAWS = 2000


def scores(results: Results, source: str, metric: str, weights: NDArray) -> NDArray:
    """The metric (runs, draws) of every run where trajectories, by their names, count so often."""
    classes = results.classes
    order = np.argsort(results.data.test.ids)
    truth = np.array([classes.index(label) for label in results.data.test.labels])[order]
    predicted = np.array(results.sources[source].predictions)[:, order]
    answers = np.eye(len(classes))[predicted]
    return np.array([weighted_score(metric, truth, run, weights, classes) for run in answers])


def main() -> None:
    before, after = map(read_results, sys.argv[1:3])
    if sorted(before.data.test.ids) != sorted(after.data.test.ids):
        raise SystemExit("the studies have other test trajectories")
    n, runs = len(after.data.test.ids), min(before.runs, after.runs)
    rng = np.random.default_rng(0)
    # The first draw is the sample itself.
    weights = np.vstack([np.ones(n, int), rng.multinomial(n, np.full(n, 1 / n), DRAWS)])
    kept = np.vstack([np.arange(runs), rng.integers(runs, size=(DRAWS, runs))])
    table = Table("source", "score", "before", "after", "difference", "95 %")
    for source in [each for each in after.sources if each in before.sources]:
        for metric in ("macro_f1", "healthy_recall"):
            pair = (scores(each, source, metric, weights) for each in (before, after))
            old, new = (each[kept, np.arange(DRAWS + 1)[:, None]].mean(axis=1) for each in pair)
            difference = new - old
            low, high = np.nanquantile(difference[1:], [0.025, 0.975])
            figures = f"{old[0]:.3f}", f"{new[0]:.3f}", f"{difference[0]:+.3f}"
            table.add_row(source, metric, *figures, f"{low:+.3f} to {high:+.3f}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
