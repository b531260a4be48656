"""Small neural networks, their training, and conditional distributions.

Belongs here: architectures, the training loop, mixtures and flows. Not here: the
method, twins, or a robot.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "flows": "FlowDistribution FlowHead",
        "mixtures": "BernoulliHead Bernoullis GaussianMixture MixtureHead",
        "networks": "CNN LSTM LSTMClassifier MLP Network Standardise StateSpace TCN",
        "training": "Fit Training isolated train",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
