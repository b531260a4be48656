"""Small neural networks, their training, and conditional distributions.

Belongs here: architectures, the training loop, mixtures and flows. Not here: the
method, twins, or a robot.
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
