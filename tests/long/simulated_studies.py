"""Simulated studies with known truths: how often intervals contain them, and verdicts err.

`python tests/long/simulated_studies.py` prints the figures of docs/theory.md. The constants of
`retwin.scores` were chosen on other simulations, which that page describes.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.scores.bootstrap import Draws, Resampling
from retwin.scores.classification import METRICS, weighted_score

EQUAL = ((36, 5, 0.8, 0.25), (90, 5, 0.8, 0.25), (90, 5, 0.8, 0.5), (90, 10, 0.9, 0.5))
"""Test trajectories, runs, macro-F1, and the standard deviation of the skill between runs, which
is about 4.5 times that of the macro-F1."""
SCORED = ("macro_f1", "balanced_accuracy", "accuracy", "healthy_recall", "auroc")


@dataclass(frozen=True)
class Classifier:
    """Trained classifiers whose logits are Gaussian around those of the true class.

    Attributes
    ----------
    classes : int
        Number of classes, which are equally frequent.
    skill : float
        Logit of the true class; every second class is harder by the factor `harder`.
    harder : float
        Factor of the skill in every second class.
    shared : float
        Share of the logits' variance that the runs of one trajectory have in common.
    spread : float
        Standard deviation of the skill between runs.

    """

    classes: int = 9
    skill: float = 3.0
    harder: float = 0.8
    shared: float = 0.7
    spread: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return ("Healthy", *(f"fault {k}" for k in range(1, self.classes)))

    def answers(self, truth: NDArray, common: NDArray, runs: int, rng: np.random.Generator):
        """Probabilities (runs, n, classes), given the part (n, classes) that runs share."""
        own = rng.standard_normal((runs, *common.shape))
        logits = np.sqrt(self.shared) * common + np.sqrt(1 - self.shared) * own
        skill = self.skill * np.where(truth % 2, self.harder, 1.0)
        skill = skill + self.spread * rng.standard_normal((runs, 1))
        logits[:, np.arange(len(truth)), truth] += skill
        powers = np.exp(logits - logits.max(axis=2, keepdims=True))
        return powers / powers.sum(axis=2, keepdims=True)

    def study(self, n: int, runs: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """True classes (n,) and probabilities of one study."""
        truth = np.arange(n) % self.classes
        return truth, self.answers(truth, rng.standard_normal((n, self.classes)), runs, rng)

    def truths(self, samples: int = 9000) -> dict[str, float]:
        """The scores of a model on an infinite test set, to about 0.001."""
        found = []
        for seed in range(10):
            truth, (answers,) = self.study(samples, 1, np.random.default_rng(seed))
            one = np.ones((1, samples))
            found.append([weighted_score(m, truth, answers, one, self.names)[0] for m in SCORED])
        return dict(zip(SCORED, np.mean(found, axis=0), strict=True))

    def with_f1(self, wanted: float) -> Classifier:
        """The classifier of that true macro-F1."""
        low, high = 0.0, 30.0
        one = np.ones((1, 9000))
        for _ in range(25):
            tried = replace(self, skill=(low + high) / 2)
            truth, (answers,) = tried.study(9000, 1, np.random.default_rng(0))
            found = weighted_score("macro_f1", truth, answers, one, self.names)[0]
            low, high = (tried.skill, high) if found < wanted else (low, tried.skill)
        return tried


def score_coverage(
    classifier: Classifier, n: int, runs: int, *, studies: int, draws: int = 500, seed: int = 0
) -> dict[str, float]:
    """Share of simulated studies whose interval contains the true score, by metric."""
    truths = classifier.truths()
    rng = np.random.default_rng(seed)
    hits = dict.fromkeys(SCORED, 0)
    for _ in range(studies):
        truth, answers = classifier.study(n, runs, rng)
        made = Resampling(truth, classifier.names, draws, int(rng.integers(2**31)))
        for metric in SCORED:
            low, high = made.of(metric, answers).interval
            hits[metric] += low <= truths[metric] <= high
    return {metric: count / studies for metric, count in hits.items()}


def false_verdicts(
    classifier: Classifier, n: int, runs: int, *, studies: int, draws: int = 500, seed: int = 0
) -> float:
    """Share of simulated studies that call one of two equal methods better in macro-F1."""
    rng = np.random.default_rng(seed)
    wrong = 0
    for _ in range(studies):
        truth = np.arange(n) % classifier.classes
        made = Resampling(truth, classifier.names, draws, int(rng.integers(2**31)))
        common = rng.standard_normal((n, classifier.classes))
        pair = [classifier.answers(truth, common, runs, rng) for _ in range(2)]
        drawn, values = zip(*(scored(made, each) for each in pair), strict=True)
        difference: Draws = drawn[0] - drawn[1]
        found = difference.with_runs(values[0] - values[1], seed=int(rng.integers(2**31)))
        wrong += found.p <= 0.05
    return wrong / studies


def scored(made: Resampling, answers: NDArray) -> tuple[Draws, NDArray]:
    """Draws of the macro-F1, and its value in each run."""
    one = np.ones((1, len(made.truth)))
    runs = [weighted_score("macro_f1", made.truth, run, one, made.classes)[0] for run in answers]
    return made.of("macro_f1", answers), np.array(runs)


def main() -> None:
    """Print the tables."""
    assert set(SCORED) <= set(METRICS)
    studies = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    print("classes n runs F1:", *SCORED)
    for classes, harder, shared in ((9, 0.8, 0.7), (4, 1.0, 0.3)):
        for n, runs in ((36, 1), (54, 5), (90, 3)):
            for f1 in (0.8, 0.9, 0.97, 0.99):
                made = Classifier(classes, harder=harder, shared=shared).with_f1(f1)
                found = score_coverage(made, n, runs, studies=studies)
                print(classes, n, runs, f1, *(f"{each:.3f}" for each in found.values()), flush=True)
    print("false verdicts: n runs F1 spread of the F1 between runs")
    for n, runs, f1, spread in EQUAL:
        made = replace(Classifier().with_f1(f1), spread=spread)
        rng = np.random.default_rng(1)
        truth, answers = made.study(9000, 30, rng)
        one = np.ones((1, 9000))
        each = [weighted_score("macro_f1", truth, run, one, made.names)[0] for run in answers]
        wrong = false_verdicts(made, n, runs, studies=studies)
        print(n, runs, f1, f"{np.std(each):.3f}", f"{wrong:.3f}", flush=True)


if __name__ == "__main__":
    main()
