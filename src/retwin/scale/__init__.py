"""Scale: any number of trajectories into one Zarr folder; bounded memory, resumable, spread out."""

from __future__ import annotations

from retwin.scale.job import Simulated, simulate_to
from retwin.scale.plan import SimulationPlan

__all__ = ["Simulated", "SimulationPlan", "simulate_to"]
