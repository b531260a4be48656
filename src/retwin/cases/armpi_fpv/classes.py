"""The nine classes of the arm's data, in their fixed order."""

from __future__ import annotations

from retwin.data.trajectories import HEALTHY

__all__ = ["BIASED", "CLASSES", "STUCK"]

STUCK = tuple(f"Motor_{i}_Stuck" for i in range(1, 5))
"""Motor i does not move any more."""
BIASED = tuple(f"Motor_{i}_Steady_state_error" for i in range(1, 5))
"""Motor i settles beside its target: the steady-state error (SSE) of the paper."""
CLASSES = (HEALTHY, *STUCK, *BIASED)
"""The order of probabilities and of confusion matrices."""
