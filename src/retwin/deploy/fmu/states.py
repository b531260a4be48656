"""Twins with state equations as C99."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from retwin.checks import require
from retwin.compiler import c_source
from retwin.deploy.fmu.description import Variable, variables_of
from retwin.deploy.fmu.text import Text, constants
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.limits import Limits
from retwin.update.corrected import CorrectedTwin
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_twin_of

UNUSED = ("start_deviation", "process", "proportional", "free_process")
"""Variances of corrected dynamics that equations without a discrepancy do not have."""


def states_text(twin: StateTwin | DynamicsTwin | CorrectedTwin) -> Text:
    """A twin with state equations, alone or with stationary noise, or corrected dynamics, as C.

    Raises
    ------
    InputError
        Its commands are splines between samples, which are not known before later samples are.

    """
    ranged = isinstance(twin, DynamicsTwin)
    corrected = twin if isinstance(twin, DynamicsTwin) else _convert(twin)
    interpolation = corrected.equations.interpolation
    expected = "commands that are held or straight lines between samples"
    got = "splines, which depend on commands that an FMU does not know yet"
    remedy = 'make the twin with interpolation="linear"'
    require(interpolation != "spline", "twin", expected=expected, got=got, remedy=remedy)
    variables, places = _variables(corrected, ranged)
    steps = c_source(__package__, "variables.c", "random.c", "states.c")
    return Text(
        "\n".join([_model(corrected, places, ranged), steps]),
        variables,
        corrected.rate,
        corrected.case,
        1 / corrected.rate if interpolation == "linear" else 0.0,
    )


def _convert(given: StateTwin | CorrectedTwin) -> DynamicsTwin:
    """The equations as corrected dynamics without discrepancy, and with white noise if any."""
    if isinstance(given, StateTwin):
        twin, values, noise = given, given.values(None, 1)[0], np.zeros(len(given.outputs))
    else:
        inside: Any = given.surrogate
        twin, _, named = state_twin_of(inside.twin)
        values = np.array([named[name] for name in twin.names])
        residual: Any = given.residual
        noise = (residual.spread * residual.scale).double().numpy() ** 2
    states, width = len(twin.states), len(twin.outputs)
    limits = twin.limits or Limits(*((0.0,) * len(twin.inputs),) * 2)
    low, high = np.array(limits.low, float), np.array(limits.high, float)
    starts, middle = values[len(values) - states :], np.clip(0.0, low, high)
    unused: Any = dict.fromkeys(UNUSED, np.zeros(states))
    ranges = [*(np.concatenate([starts, each]) for each in (low, high, middle)), np.ones(states)]
    return DynamicsTwin(
        equations=twin,
        values=values,
        factor=np.zeros((len(values), 0)),
        **unused,
        noise=noise,
        widening=np.ones(width),
        constant=np.zeros(width),
        domain=Domain(*ranges),
        corrected=(),
        case=getattr(given, "case", ""),
    )


def _variables(twin: DynamicsTwin, ranged: bool) -> tuple[list[Variable], list[int]]:
    """The variables, and the value references of parameters and starts; -1 for none."""
    equations = twin.equations
    inputs, outputs = len(equations.inputs), len(equations.outputs)
    states = len(equations.states)
    # Coefficients of the discrepancy have names of several words.
    shown = [each.name.isidentifier() for each in equations.parameters]
    values = twin.values.tolist()
    pairs = zip(equations.parameters, values, strict=False)
    parameters = [pair for pair, own in zip(pairs, shown, strict=True) if own]
    starts = [
        (each.name, each.unit, value)
        for each, value in zip(equations.states, values[-states:], strict=True)
    ]
    ends = twin.domain.low[states:].tolist(), twin.domain.high[states:].tolist()
    given = equations.limits
    limits = None if given is None and not ranged else list(zip(*ends, strict=True))
    first = twin.domain.mean[states:].tolist()
    channels = (equations.inputs, equations.outputs)
    made = variables_of(*channels, first, parameters, starts, limits=limits, ranged=ranged)
    listed = np.array([*shown, *[True] * states])
    places = np.where(listed, 2 * inputs + 5 * outputs + listed.cumsum(), -1)
    return made, places.tolist()


def _model(twin: DynamicsTwin, places: Sequence[int], ranged: bool) -> str:
    """The equations of a twin and its numbers as C."""
    states, outputs = len(twin.process), len(twin.outputs)
    delays = twin.equations.delay_places
    longest = [twin.equations.parameters[place].high for _, place in delays]
    sizes = {
        "NR": twin.factor.shape[1],
        "NV": 1 + 2 * len(twin.inputs) + 5 * outputs + sum(each >= 0 for each in places),
        "SUBSTEPS": twin.equations.substeps,
        "LINEAR": int(twin.equations.interpolation == "linear"),
        "NI": len(twin.inputs),
        "ND": len(delays),
        "PAST": 3 + ceil(max(longest, default=0.0) * twin.rate),
    }
    arrays: Mapping[str, ArrayLike] = {
        "VALUES": twin.values,
        "FACTOR": twin.factor.ravel(),
        "START": twin.start_deviation,
        "PROCESS": twin.free_process,
        "NOISE": twin.noise,
        "WIDENING": twin.widening,
        "CONSTANT": twin.constant,
        "FIRST": twin.domain.mean[states:],
        "LONGEST": longest,
    }
    if ranged:
        low, high = twin.bounds
        arrays = {**arrays, "LEAST": low, "GREATEST": high}
    lines = [f"#define {name} {size}" for name, size in sizes.items()]
    lines += ["#define RANGED"] * ranged
    lines.append(f"#define PERIOD {1 / twin.rate!r}")
    lines += [constants(name, values) for name, values in arrays.items()]
    indices = {"PLACE": places, "DELAYED": [u for u, _ in delays], "DEAD": [p for _, p in delays]}
    lines += [constants(name, values, "int") for name, values in indices.items()]
    return "\n".join([twin.equations.stepped.steps_source, *lines])
