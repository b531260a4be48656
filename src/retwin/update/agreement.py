"""`check_with_twin`: records and the twin that they are for, before anything is learned."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.agreement import explained_shares
from retwin.data.quality.check import Checked, check_records
from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.windows import simulated as simulated_outputs
from retwin.update.forecasts import started_moments

DIVERGED = 1e100
"""Size of outputs that no simulation has which does not diverge, and whose square is finite."""


def check_with_twin(twin: Twin | None, records: Trajectories) -> Checked:
    """Check records against a twin: `check_records` by its outputs, and exchanged commands.

    Parameters
    ----------
    twin : Twin or None
        With the channels of the records. Where it is None, or cannot simulate the commands, the
        nominal outputs of the records are taken.
    records : Trajectories
        Recorded outputs with commands.

    Returns
    -------
    Checked
        Its `findings` are none for clean records.

    """
    ideal = None if twin is None else simulated(twin, records)
    if twin is None or ideal is None:
        return check_records(records)
    found = check_records(records.replace(nominal=ideal))
    return replace(found, findings=(*_find_exchanged(twin, found.records), *found.findings))


def simulated(twin: Twin, records: Trajectories) -> NDArray | None:
    """What a twin simulates for the commands (n, T, d_y); None if it cannot.

    Starts of states that the twin does not state are those that fit each record.
    """
    try:
        with np.errstate(all="ignore"):  # of a simulation that diverges nothing else is to be said
            if isinstance(twin, ParametricTwin):
                made = simulated_outputs(twin, records, records.mask, seed=0, own=True)
            elif isinstance(twin, DynamicsTwin):
                made = started_moments(twin, records, records.steps / records.rate)[0]
            else:
                made = twin.simulate(records.commands, seed=0).observed
    except (InputError, SimulationError):
        return None
    return made if np.all(np.abs(made, dtype=float) < DIVERGED) else None


def _find_exchanged(twin: Twin, records: Trajectories, *, clear: float = 0.5) -> Iterator[Finding]:
    """Pairs of commands with which the twin explains more where they are exchanged.

    Parameters
    ----------
    clear : float, default 0.5
        Ratio of residuals from which exchanged commands are named.

    """
    healthy = records[records.maybe_healthy] if records.maybe_healthy.any() else records
    here, names = _unexplained_share(healthy), records.inputs.names
    # Share of the variance that a twin leaves, below which commands are in their places.
    if here < 0.1:
        return
    # Pairs of commands that are tried, at most.
    for a, b in list(combinations(range(len(names)), 2))[:15]:
        order = np.arange(len(names))
        order[[a, b]] = order[[b, a]]
        other = healthy.replace(commands=healthy.commands[..., order])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of commands that the machine never had
            ideal = simulated(twin, other)
        if ideal is None:
            continue
        there = _unexplained_share(other.replace(nominal=ideal))
        if there < min(clear * here, clear):
            text = f"seems to be exchanged with {names[b]}: its twin explains {1 - there:.0%} of "
            text += f"the variance that way, {1 - here:.0%} as they are"
            yield Finding("", names[a], "exchanged", text)


def _unexplained_share(records: Trajectories) -> float:
    """Share of the variance that nominal outputs do not explain, over all outputs that change."""
    shares = explained_shares(records)
    left = [1 - each for own in shares.values() for each in own.values() if np.isfinite(each)]
    return float(np.mean(left or [0.0]))
