"""`fit_diagnoser`: the one way to train a diagnoser on labelled trajectories."""

from __future__ import annotations

from collections.abc import Sequence

from retwin.checks import instance, require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.diagnoser import Method, TrainedDiagnoser, TrainingTask
from retwin.diagnosis.trained.network import fit_network
from retwin.nets.networks import CNN, Network
from retwin.nets.training import Training
from retwin.progress import Progress

Classifier = Network | Method
"""What `fit_diagnoser` can train: a network such as `CNN` or `LSTMClassifier`, or a method such as
`Rocket`, `DANN` or `FineTune`."""


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
) -> TrainedDiagnoser:
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
        Sample rate of the features in Hz, such as the true one of the sensor; by default the
        lowest that keeps a hundred samples of each trajectory. `FineTune` keeps that of its base.
    training : Training, optional
        Epochs, batch size and learning rate; by default those that suit the network. `Rocket` has
        none, since its weights have a closed form.
    progress : Progress, optional
        Called with the share that is done.

    Returns
    -------
    NetworkDiagnoser or RocketDiagnoser, or what another `Method` makes
        `fitted.figures` holds the `accuracy` on the held-out fifth, where there is one.

    Raises
    ------
    InputError
        If trajectories are not labelled with at least two of `classes`, `rate` does not divide
        the rate of the trajectories, `target` is missing or has no use, or `target` has other
        channels or another rate.

    """
    remedy = "load recorded ones, or simulate a twin"
    instance("trajectories", trajectories, Trajectories, remedy=remedy)
    adapts = isinstance(classifier, Method) and classifier.adapts
    expected = f"{'real trajectories' if adapts else 'none'} for {type(classifier).__name__}"
    got = "none" if target is None else f"{len(target)} trajectories"
    remedy = "give real trajectories to DANN and FineTune, and to no other classifier"
    require((target is not None) == adapts, "target", expected=expected, got=got, remedy=remedy)
    task = TrainingTask(trajectories, target, seed, classes, rate, training, progress)
    if isinstance(classifier, Method):
        return classifier.fit(task)
    return fit_network(classifier, task)
