"""How real what a twin generates is, on measured healthy trajectories that it has not seen."""

from retwin.evaluation.fidelity.figures import Fidelity, Figure
from retwin.evaluation.fidelity.measure import measure_fidelity, measure_widening
from retwin.evaluation.fidelity.portrait import Overlay, predictive_overlay
from retwin.evaluation.fidelity.simulation import Simulation, simulate_records

__all__ = [
    "Fidelity",
    "Figure",
    "Overlay",
    "Simulation",
    "measure_fidelity",
    "measure_widening",
    "predictive_overlay",
    "simulate_records",
]
