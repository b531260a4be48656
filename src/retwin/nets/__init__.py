"""Small neural networks, their training, and conditional distributions.

Belongs here: architectures, the training loop, mixtures and flows. Not here: the
method, twins, or a robot.
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "BernoulliHead": "mixtures",
    "Bernoullis": "mixtures",
    "CNN": "networks",
    "Fit": "training",
    "FlowDistribution": "flows",
    "FlowHead": "flows",
    "GaussianMixture": "mixtures",
    "LSTM": "networks",
    "LSTMClassifier": "networks",
    "MLP": "networks",
    "MixtureHead": "mixtures",
    "Network": "networks",
    "Standardise": "networks",
    "StateSpace": "networks",
    "TCN": "networks",
    "Training": "training",
    "isolated": "training",
    "train": "training",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
