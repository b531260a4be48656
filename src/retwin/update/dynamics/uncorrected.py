"""`estimate_noise`: state equations as they are, as a distribution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from retwin.data.quality.copies import distinct_records
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import checked_stride
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.sensor_limits import limit_equations
from retwin.update.dynamics.candidates import hold_confounded, without_discrepancy
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.filter.noise import folds, widening
from retwin.update.dynamics.fitting import assembled
from retwin.update.dynamics.linearised import HeldOut, Point
from retwin.update.dynamics.settings import Dynamics
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of
from retwin.workers.threads import one_thread

__all__ = ["estimate_noise"]


@one_thread()
def estimate_noise(twin: StateTwin | ParametricTwin, observed: Trajectories) -> DynamicsTwin:
    """State equations without a correction, with the noise of states and outputs in records.

    Parameters
    ----------
    twin : StateTwin or ParametricTwin
        The equations; their parameters keep their values, and are as uncertain as these records
        leave them.
    observed : Trajectories
        Healthy trajectories; unknown starts of the states are estimated for each.

    Raises
    ------
    InputError
        A twin that is no `StateTwin`, other channels or another rate, or a simulation that is not
        finite.

    """
    base, free, values = state_twin_of(twin)
    checked_stride(base, observed, None, "observed")
    base = limit_equations(base, limits_of(observed))
    observed = observed[distinct_records(np.where(observed.mask, observed.observed, np.nan))]
    unknowns = unknowns_of(base, free, values)
    settings = Dynamics(Library(0, (), False))  # the least one, for its states and their speeds
    parts = folds(observed.mask, settings.folds)
    starts, found = without_discrepancy(base, observed, unknowns.only(np.arange(0)))
    whole = replace(starts, unknowns=unknowns, absorbed=None)
    found = whole.linearised(Point(unknowns.mean, found.point.starts))
    whole = hold_confounded(whole, found)
    visited = whole.simulated(found.point)[1], whole.commands
    assert settings.library is not None
    equations = CorrectedEquations.distinct(
        base, settings.library, settings, visited, unknowns.matrix
    )
    moves = np.zeros((len(parts), unknowns.count))  # no part moves parameters that are held
    corrected = equations.states, equations.domain.speed
    made = assembled(whole, found, *corrected, parts, moves)
    errors = np.where(whole.seen, found.residual, 0.0)
    return replace(made, widening=widening(made, whole, HeldOut(errors, 0 * errors, moves)))
