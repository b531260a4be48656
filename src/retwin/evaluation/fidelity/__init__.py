"""Fidelity: how well the distribution of a twin's outputs matches measured healthy trajectories."""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "figures": "Fidelity Figure",
        "measure": "measure_fidelity measure_widening",
        "overlay": "Overlay predictive_overlay",
        "simulation": "Simulation record_means simulate_records simulation_scores",
    }
)
__getattr__, __dir__, __all__ = names(__name__, _HOME)
