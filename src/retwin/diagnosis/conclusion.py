"""`conclude`: what a diagnoser of any kind says of each trajectory, "unknown" included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of, require
from retwin.data.measured import unmeasured_outputs
from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.diagnosis.diagnoser import Diagnoser
from retwin.diagnosis.inversion.states import StateDiagnosis, StateInversionDiagnoser
from retwin.diagnosis.inversion.trajectories import Diagnosis, InversionDiagnoser
from retwin.progress import Progress


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a diagnoser says of n trajectories.

    Attributes
    ----------
    probabilities : NDArray
        (n, C), see `Diagnoser`.
    labels : NDArray
        (n,), the most probable class, or "unknown".
    reason : NDArray
        (n,), why a trajectory is unknown; "" where it is not.
    remark : str
        What "unknown" rests on, and what cannot be recognised.
    found : Diagnosis or StateDiagnosis or None
        All that an inversion infers; None for other diagnosers.

    """

    probabilities: NDArray
    labels: NDArray
    reason: NDArray
    remark: str = ""
    found: Diagnosis | StateDiagnosis | None = None


def conclude(
    diagnoser: Diagnoser,
    trajectories: Trajectories,
    *,
    max_faults: int = 1,
    progress: Progress | None = None,
) -> Conclusion:
    """Diagnose trajectories by a diagnoser of any kind.

    Parameters
    ----------
    diagnoser : Diagnoser
        An inversion also states why a trajectory is unknown.
    trajectories : Trajectories
        Commands and measured outputs.
    max_faults : int, default 1
        See `InversionDiagnoser.diagnose`; other diagnosers take 1 alone.
    progress : callable, optional
        Called with the share of the work that is done.

    Raises
    ------
    InputError
        See `Diagnoser.predict_proba`, or `max_faults` of a diagnoser that takes 1 alone.

    """
    pairs = isinstance(diagnoser, InversionDiagnoser)
    one_of("max_faults", max_faults, (1, 2) if pairs else (1,), remedy="invert in command space")
    found: Diagnosis | StateDiagnosis
    if isinstance(diagnoser, InversionDiagnoser | StateInversionDiagnoser):
        if isinstance(diagnoser, InversionDiagnoser):
            found = diagnoser.diagnose(trajectories, max_faults=max_faults, progress=progress)
        else:
            found = diagnoser.diagnose(trajectories, progress=progress)
        remark = str(getattr(diagnoser, "calibration", ""))
        return Conclusion(found.probabilities, found.labels, found.reason, remark, found)
    probabilities = np.asarray(diagnoser.predict_proba(trajectories))
    shape = len(trajectories), len(diagnoser.classes)
    fits = probabilities.dtype.kind in "biuf" and probabilities.shape == shape
    expected = f"probabilities of {shape[1]} classes"
    got = f"{probabilities.dtype} of shape {probabilities.shape}"
    remedy = "train it anew, or give another one"
    require(fits, "diagnoser", expected=expected, got=got, remedy=remedy)
    reason = unmeasured_outputs(trajectories)
    labels = np.array(diagnoser.classes)[probabilities.argmax(axis=1)]
    remark = "only trajectories without any measurement are called unknown; a bundle has a guard"
    return Conclusion(probabilities, np.where(reason == "", labels, UNKNOWN), reason, remark)
