"""`fit_diagnoser`: the one way to train a diagnoser on labelled trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.adversarial import DANN, fit_dann
from retwin.diagnosis.fine_tuning import FineTune, fine_tune
from retwin.diagnosis.network import NetworkDiagnoser, fit_network
from retwin.diagnosis.rocket import Rocket, RocketDiagnoser, fit_rocket
from retwin.nets.networks import CNN, Network
from retwin.nets.training import Training
from retwin.progress import Progress

__all__ = ["Classifier", "fit_diagnoser"]

Classifier = Network | Rocket | DANN | FineTune
"""What `fit_diagnoser` can train: a network such as `CNN` or `LSTMClassifier`, or a method."""


def fit_diagnoser(
    trajectories: Trajectories,
    classifier: Classifier = CNN(),  # noqa: B008 - a frozen config
    *,
    target: Trajectories | None = None,
    seed: int,
    classes: Sequence[str] | None = None,
    rate: float | None = None,
    training: Training | None = None,
    progress: Progress | None = None,
) -> NetworkDiagnoser | RocketDiagnoser:
    """Train a classifier on labelled trajectories.

    Parameters
    ----------
    trajectories : Trajectories
        The labelled training set, usually generated. A stratified fifth of it is held out: to
        choose the best epoch of a network, to scale the probabilities of `Rocket`, and for the
        figures of `DANN`. `FineTune` uses all of it for training.
    classifier : Classifier
        `CNN`, `LSTMClassifier`, `Rocket`, `DANN` or `FineTune`.
    target : Trajectories, optional
        Real trajectories, for `DANN` (their labels have no effect) and `FineTune` (labelled).
        Other classifiers learn from `trajectories` alone.
    seed : int
        The same seed gives the same weights on the same machine.
    classes : sequence of str, optional
        Class names in the order of the probabilities; by default sorted. `FineTune` keeps those
        of its base.
    rate : float, optional
        Sample rate of the features in Hz; by default 10 Hz, or the rate of the trajectories if it
        is lower. `FineTune` keeps that of its base.
    training : Training, optional
        Epochs, batch size and learning rate; by default those that suit the network. `Rocket` has
        none, since its weights have a closed form.
    progress : Progress, optional
        Called with the share that is done.

    Returns
    -------
    NetworkDiagnoser or RocketDiagnoser
        `fitted.figures` holds the `accuracy` on the held-out fifth, where there is one.

    Raises
    ------
    InputError
        If trajectories are not labelled with at least two of `classes`, `rate` does not divide
        the rate of the trajectories, `target` is missing or has no use, or `target` has other
        channels or another rate.

    """
    _check_arguments(classifier, target, classes, rate, training)
    how: dict[str, Any] = {"seed": seed, "training": training, "progress": progress}
    features: dict[str, Any] = {"classes": classes, "rate": rate}
    real: dict[str, Any] = {"target": target}
    match classifier:
        case DANN():
            return fit_dann(trajectories, classifier, **real, **features, **how)
        case FineTune():
            return fine_tune(trajectories, classifier, **real, **how)
        case Rocket():
            return fit_rocket(trajectories, classifier, **features, seed=seed, progress=progress)
        case _:
            return fit_network(trajectories, classifier, **features, **how)


def _check_arguments(
    classifier: Classifier,
    target: Trajectories | None,
    classes: Sequence[str] | None,
    rate: float | None,
    training: Training | None,
) -> None:
    """Refuse arguments that the classifier needs and lacks, or that have no use for it."""
    adapts = isinstance(classifier, DANN | FineTune)
    require(
        (target is not None) == adapts,
        "target",
        expected=f"{'real trajectories' if adapts else 'none'} for {type(classifier).__name__}",
        got="none" if target is None else f"{len(target)} trajectories",
        remedy="give real trajectories to DANN and FineTune, and to no other classifier",
    )
    if isinstance(classifier, FineTune):
        require(
            classes is None and rate is None,
            "classes and rate",
            expected="none for FineTune, which keeps those of its base",
            got=f"{classes} and {rate}",
            remedy="leave them out, or train another base",
        )
    if isinstance(classifier, Rocket):
        require(
            training is None,
            "training",
            expected="none for Rocket, whose weights have a closed form",
            got=training,
            remedy="leave it out",
        )
