"""Simulations of any number of trajectories into one Zarr folder.

Memory is bounded by one chunk per worker, an interrupted job resumes, and chunks are distributed
over processes or a Dask cluster.
"""

from __future__ import annotations

from retwin.deploy.simulations.job import Simulated, simulate_to
from retwin.deploy.simulations.plan import SimulationPlan

__all__ = ["Simulated", "SimulationPlan", "simulate_to"]
