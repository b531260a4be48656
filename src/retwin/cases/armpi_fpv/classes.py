"""The nine classes of the arm's data, in their fixed order."""

from __future__ import annotations

from retwin.data.trajectories import HEALTHY

STUCK = tuple(f"Motor_{i}_Stuck" for i in range(1, 5))
"""Classes in which motor i stops moving."""
BIASED = tuple(f"Motor_{i}_Steady_state_error" for i in range(1, 5))
"""Classes in which motor i settles at a biased target: the paper's steady-state error (SSE)."""
CLASSES = (HEALTHY, *STUCK, *BIASED)
"""All classes in the order of probabilities and of confusion matrices."""
