"""Which trajectories to record next, and whether there are enough."""

from __future__ import annotations
