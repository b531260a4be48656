"""Evaluations that need a model: diagnosers on test trajectories, twins on measured ones.

Belongs here: what runs a model and passes its outputs to `scores`. Not here: formulas of scores,
and the choice of what is compared (see `study`).
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
