"""Scale: any number of trajectories into one Zarr folder; bounded memory, resumable, spread out."""

from __future__ import annotations

from retwin.deploy.simulations.job import Simulated, simulate_to
from retwin.deploy.simulations.plan import SimulationPlan

__all__ = ["Simulated", "SimulationPlan", "simulate_to"]
