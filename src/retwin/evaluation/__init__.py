"""Evaluations that need a model: diagnosers on test trajectories, twins on measured ones.

Belongs here: what runs a model and passes its outputs to `scores`. Not here: formulas of scores,
and the choice of what is compared (see `study`).
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "choice": "CandidateScore Choice Fitted ModelScore StandIn SurrogateSettings fit "
        "predict_records score_model stand_in",
        "diagnosers": "evaluate",
        "experiments.propose": "Proposal next_experiments",
        "fidelity": "Fidelity Figure Overlay Simulation measure_fidelity measure_widening "
        "predictive_overlay record_means simulate_records simulation_scores",
        "identification.hold_out": "hold_out",
        "identification.validation": "Identification validate_identification",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
