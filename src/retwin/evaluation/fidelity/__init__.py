"""How real what a twin generates is, on measured healthy trajectories that it has not seen."""

from retwin.evaluation.fidelity.figures import Fidelity, Figure
from retwin.evaluation.fidelity.measure import measure_fidelity, measure_widening
from retwin.evaluation.fidelity.portrait import Portrait, portray
from retwin.evaluation.fidelity.simulation import Simulation, simulate_records

__all__ = [
    "Fidelity",
    "Figure",
    "Portrait",
    "Simulation",
    "measure_fidelity",
    "measure_widening",
    "portray",
    "simulate_records",
]
