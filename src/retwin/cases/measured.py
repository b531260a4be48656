"""What identification uses of measured trajectories, and what is noted of the rest."""

from __future__ import annotations

import numpy as np

from retwin.checks import require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError

CONSTANT = "constant in all logs, so that they show no dynamics of it."
"""What is noted of channels that never change."""


def usable(found: Trajectories, notes: dict[str, list[str]], transient: float) -> Trajectories:
    """The healthy and the unlabelled trajectories, without their outputs in the first seconds.

    Parameters
    ----------
    found : Trajectories
        Those of all logs.
    notes : dict of str to list of str
        Takes notes about all logs together.
    transient : float
        Duration in s.

    Raises
    ------
    InputError
        None is healthy, a number stands for a missing measurement, or no output is left.

    """
    joined = _healthy(found, notes)
    _check_size(joined)
    if transient:
        joined = _mask_transient(joined, transient)
    unseen = ~joined.mask.any(axis=(0, 1))
    if unseen.any():
        lacking = ", ".join(np.array(joined.outputs.names)[unseen])
        notes[f"No log holds {lacking}."] = []
    constant = ", ".join(_constant(joined))
    if constant:
        notes[f"{constant}: {CONSTANT}"] = []
    return joined


def _healthy(found: Trajectories, notes: dict[str, list[str]]) -> Trajectories:
    """The healthy and the unlabelled trajectories; InputError if there is none."""
    kept = found.maybe_healthy
    require(
        kept.any(),
        "logs",
        expected=f"a trajectory without a label, or labelled {HEALTHY}",
        got=f"labels {', '.join(sorted(found.known_labels))}",
        remedy="identify the parameters of a healthy system",
    )
    if not kept.all():
        notes[f"{int((~kept).sum())} trajectories of other classes are not used."] = []
    return found[kept]


def _check_size(found: Trajectories, *, largest: float = 1e30) -> None:
    """Refuse numbers that stand for missing measurements.

    Parameters
    ----------
    largest : float, default 1e+30
        Magnitude from which a number is no measurement: programs write 3.4e38 for a missing one.

    """
    for name, values in (("observed", found.observed), ("commands", found.commands)):
        large = np.argwhere(np.abs(values) >= largest)
        channels = found.outputs if name == "observed" else found.inputs
        if len(large):
            row, sample, channel = large[0]
            raise InputError(
                str(found.ids[row]),
                expected=f"numbers below {largest:g}",
                got=f"{values[row, sample, channel]:g} for {channels.names[channel]} at "
                f"{sample / found.rate:g} s",
                remedy="leave the cell empty, or write NaN, where a measurement is missing",
            )


def _constant(found: Trajectories) -> list[str]:
    """Channels that never change, among the commands and the outputs that were measured."""
    values = np.where(found.mask, found.observed, np.nan)
    every = np.moveaxis(np.concatenate([found.commands, values], axis=2), 2, 0)
    return [
        name
        for name, each in zip((*found.inputs.names, *found.outputs.names), every, strict=True)
        if np.isfinite(each).any() and float(np.nanmax(each)) == float(np.nanmin(each))
    ]


def _mask_transient(found: Trajectories, transient: float) -> Trajectories:
    """The trajectories without their outputs in the first seconds."""
    mask = found.mask.copy()
    mask[:, : round(transient * found.rate)] = False
    require(
        mask.any(),
        "transient",
        expected=f"less than the {found.steps / found.rate:g} s of the longest trajectory",
        got=f"{transient:g} s",
        remedy="give a shorter transient",
    )
    return found.replace(mask=mask)
