"""Faults of n trajectories: their severities drawn, their references, and what freezes.

A fault holds times in seconds, and gets the sample rate of the arrays that it changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_per, require
from retwin.data.segments import Segments
from retwin.times import to_samples
from retwin.twins.compiled.commands import biased_references
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Faults, Stuck


def draw_faults(
    faults: Faults, segments: Segments, seed: int, *, rate: float
) -> list[Fault | None]:
    """Draw the severity of every fault.

    Parameters
    ----------
    faults : sequence of Fault or None
        One per trajectory, None for a healthy one.
    segments : Segments
        Segments of the n trajectories.
    seed : int
        The same seed gives the same severities with every twin, so that twins can be compared.
    rate : float
        Sample rate in Hz.

    Returns
    -------
    list of Fault or None
        The faults with fixed severities.

    Raises
    ------
    InputError
        Not one fault per trajectory, or one that would begin after the end of its trajectory.

    """
    remedy = "give None for a healthy trajectory"
    one_per("faults", faults, len(segments), "trajectory", remedy=remedy)
    rng = np.random.default_rng(seed)
    counts = segments.valid.sum(axis=1)
    return [
        None
        if fault is None
        else fault.drawn(rng, steps=segments.steps, segments=int(count), rate=rate)
        for fault, count in zip(faults, counts, strict=True)
    ]


def faulty_commands(
    commands: NDArray, faults: Faults, segments: Segments, *, rate: float
) -> NDArray:
    """Commands with the effect of every fault on the reference.

    Parameters
    ----------
    commands : ndarray, shape (n, T, d_u)
        Clean commands.
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.
    segments : Segments
        Segments of the commands.
    rate : float
        Sample rate in Hz.

    Returns
    -------
    ndarray, shape (n, T, d_u)
        Effective commands.

    """
    out = commands.copy()
    count = segments.valid.sum(axis=1).tolist()
    # What is computed together: many trajectories with the same kind of fault are common.
    pairs = list(zip(faults, count, strict=True))
    biased = [each if type(each) is ActuatorBias and n > 0 else None for each, n in pairs]
    biases = [each.levels(n) if each else () for each, n in zip(biased, count, strict=True)]
    actuators = [each.actuator if each else -1 for each in biased]
    together = any(biased) and biased_references(commands, out, actuators, biases, segments)
    for i, fault in enumerate(faults):
        if fault is None or (together and biased[i]):
            continue
        effective = fault.command(commands[i], segments[i : i + 1], rate)
        if effective is not commands[i]:
            out[i] = effective
    return out


def frozen_response(response: NDArray, faults: Faults, *, rate: float) -> NDArray:
    """Response of the actuators with the effect of every fault on it.

    A twin whose actuators cannot be accessed applies this to its commands, which are then held.

    Parameters
    ----------
    response : ndarray, shape (n, T, d_u)
        Response without faults, in command units.
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.
    rate : float
        Sample rate in Hz.

    Returns
    -------
    ndarray, shape (n, T, d_u)
        The response with faults.

    """
    out = response.copy()
    for i, fault in enumerate(faults):
        if fault is not None:
            out[i] = fault.response(response[i], rate)
    return out


def frozen_from(faults: Faults, steps: int, actuators: int, *, rate: float) -> NDArray:
    """Sample from which every actuator is held.

    For twins that integrate their dynamics and must hold an actuator meanwhile. The sample is
    found from the effect of the fault on a response that rises by one per sample.

    Parameters
    ----------
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.
    steps : int
        Samples per trajectory, T.
    actuators : int
        The number of actuators, d_u.
    rate : float
        Sample rate in Hz.

    Returns
    -------
    ndarray of int, shape (n, d_u)
        Samples counted from 0; `steps` where an actuator is never held.

    Raises
    ------
    InputError
        A fault that neither holds the response nor leaves it unchanged.

    """
    rising = np.tile(np.arange(steps, dtype=float)[:, None], (1, actuators))
    onsets = np.full((len(faults), actuators), steps)
    for i, fault in enumerate(faults):
        if fault is None:
            continue
        if type(fault) is Stuck and not isinstance(fault.onset, tuple):
            held = to_samples(fault.onset, rate)
            onsets[i, fault.actuator] = held if held < steps - 1 else steps
            continue
        response = fault.response(rising, rate)
        if response is rising:
            continue
        onset = response[-1].astype(int)
        fits = np.array_equal(response, np.minimum(rising, onset))
        expected = "faults that hold an actuator's response or leave it as it is"
        remedy = "use a twin that computes its actuators' response, or faults of the command"
        require(fits, "faults", expected=expected, got=fault, remedy=remedy)
        onsets[i] = np.where(onset < steps - 1, onset, steps)
    return onsets
