"""Evaluations that need a model: diagnosers on test trajectories, twins on measured ones.

Belongs here: what runs a model and passes its outputs to `scores`. Not here: formulas of scores,
and the choice of what is compared (see `study`).
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Fidelity": "fidelity",
    "Figure": "fidelity",
    "Identification": "identification",
    "Overlay": "fidelity",
    "Proposal": "experiments.propose",
    "Simulation": "fidelity",
    "evaluate": "diagnosers",
    "hold_out": "identification",
    "measure_fidelity": "fidelity",
    "measure_widening": "fidelity",
    "next_experiments": "experiments.propose",
    "predictive_overlay": "fidelity",
    "record_means": "fidelity",
    "simulate_records": "fidelity",
    "simulation_scores": "fidelity",
    "validate_identification": "identification",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
