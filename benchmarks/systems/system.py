"""`System`: a twin as a user would write it, the records, and how they are scored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import retwin as rt


@dataclass(frozen=True)
class System:
    """A real or an emulated system with its twin.

    Attributes
    ----------
    twin : ParametricTwin
        The twin before it is identified, with its uncertain parameters free.
    calibration : Trajectories
        All that a method sees.
    tests : mapping of str to Trajectories
        Records that are scored, by the row of the table; systems may share a row, as folds do.
    unit : str
        The unit of the scores.
    scale : float
        What that of the outputs is multiplied with.
    warm_up : float
        Duration in s at the begin of a test record from which the starts of states are inferred,
        and which is not scored; 0 if the starts are those of the calibration.
    horizon : float, optional
        Time in s ahead of the last measurement at which models are judged; by default free
        simulation, whose error grows without bound where a twin integrates.
    published : str
        Scores of others on the same test record, with their source.
    corrections : mapping of str to Correction
        Corrections per segment, of a system whose commands move and rest.
    surrogate : object, optional
        What stands in for the twin in these: the twin itself, differentiable.
    hidden_truth : callable, optional
        Scores of what a model in command space infers from the outputs of test records, as text.
    data : str
        Systems of the same name have the same records and differ in their twins.

    """

    twin: rt.ParametricTwin
    calibration: rt.Trajectories
    tests: Mapping[str, rt.Trajectories]
    unit: str
    scale: float = 1.0
    warm_up: float = 0.0
    horizon: float | None = None
    published: str = ""
    corrections: Mapping[str, rt.Correction] = field(default_factory=dict)
    surrogate: Any = None
    hidden_truth: Callable[[rt.CorrectedTwin, rt.Trajectories], str] | None = None
    data: str = ""


def trajectory(
    twin: rt.Twin, commands: NDArray, outputs: NDArray, *, emulated: bool = False
) -> rt.Trajectories:
    """Records of one command and one output, each (T,) or (n, T), as `Trajectories`."""
    observed = np.atleast_2d(outputs)[..., None]
    return rt.Trajectories(
        np.atleast_2d(commands)[..., None],
        np.zeros(observed.shape),
        observed,
        twin.rate,
        labels=np.full(len(observed), "Healthy"),
        inputs=twin.inputs,
        outputs=twin.outputs,
        emulated=emulated,
    )
