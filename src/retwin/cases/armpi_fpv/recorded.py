"""The arm's recorded data: classes, channels, and commands recovered from the desired path."""

from __future__ import annotations

import warnings

import numpy as np

from retwin.cases.armpi_fpv.recovery import recover_commands
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC
from retwin.cases.recorded import RecordedCase
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.progress import Progress

STUCK = tuple(f"Motor_{i}_Stuck" for i in range(1, 5))
"""Classes in which motor i stops moving."""
BIASED = tuple(f"Motor_{i}_Steady_state_error" for i in range(1, 5))
"""Classes in which motor i settles at a biased target: the paper's steady-state error (SSE)."""
CLASSES = (HEALTHY, *STUCK, *BIASED)
"""All classes in the order of probabilities and of confusion matrices."""


def recover(trajectories: Trajectories, progress: Progress | None = None) -> Trajectories:
    """Recover commands from the desired path; a warning names ambiguous trajectories.

    Parameters
    ----------
    trajectories : Trajectories
        Trajectories whose `nominal` is the desired end-effector path in m.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Trajectories
        The same with commands.

    """
    found = recover_commands(trajectories.nominal, arm=ARM, progress=progress)
    ambiguous = np.any(found.ambiguous, axis=1)
    if ambiguous.any():
        warnings.warn(
            f"commands of {ambiguous.sum()} of {len(ambiguous)} trajectories are not certain: "
            f"{', '.join(trajectories.ids[ambiguous][:5])}{' …' if ambiguous.sum() > 5 else ''}",
            stacklevel=2,
        )
    return trajectories.replace(
        commands=found.commands.astype(np.float32),
        inputs=KINEMATIC.inputs,
        outputs=KINEMATIC.outputs,
    )


RECORDED = RecordedCase(CLASSES, KINEMATIC, recover)
"""What files of the arm's trajectories need of its case."""
