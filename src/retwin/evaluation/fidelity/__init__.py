"""Fidelity: how well the distribution of a twin's outputs matches measured healthy trajectories."""

from retwin.evaluation.fidelity.figures import Fidelity, Figure
from retwin.evaluation.fidelity.measure import measure_fidelity, measure_widening
from retwin.evaluation.fidelity.overlay import Overlay, predictive_overlay
from retwin.evaluation.fidelity.simulation import (
    Simulation,
    record_means,
    simulate_records,
    simulation_scores,
)

__all__ = [
    "Fidelity",
    "Figure",
    "Overlay",
    "Simulation",
    "measure_fidelity",
    "measure_widening",
    "predictive_overlay",
    "record_means",
    "simulate_records",
    "simulation_scores",
]
