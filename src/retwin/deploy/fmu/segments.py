"""Corrections with one z per segment as C99, by past commands alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from retwin.checks import given
from retwin.deploy.actuator.draws import causal_part, drawn, still_and_fastest
from retwin.deploy.fmu.networks import flat
from retwin.deploy.fmu.text import constants
from retwin.twins.twin import checked_commands
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Chain, DelayOffset

DRAWS = 1024
"""Draws of z from which the seed of an instance selects one."""
ENSEMBLE = 64
"""Draws that each FMU simulates beside its own, for means and quantiles."""
SEED = 0
"""Of the draws: the same twin gives the same bytes."""


def segment_parts(
    twin: CorrectedTwin, commands: NDArray | None
) -> tuple[list[str], tuple[str, ...]]:
    """Delays, offsets and missed segments as C text, and what of the correction is left out.

    z of a segment depends on where it ends and how long it rests then. These are not known when it
    begins. Therefore one z is drawn for the whole simulation, at the segments of `commands`, as for
    an exported actuator: the error is then the same before and after a motion.

    Raises
    ------
    InputError
        No commands, or an operator whose segments or delays are not those of past commands.

    """
    operator = causal_part(twin, any_outputs=True)[1]
    some = given(
        "commands",
        commands,
        f"commands like those of the task, for {type(operator).__name__}: z of a segment depends "
        "on where it ends, which is known only after it, so that z is drawn beforehand",
        remedy="give those of the case's sampler, or recorded ones",
    )
    some = checked_commands(some, twin.inputs).astype(np.float32, copy=False)
    found = drawn(twin, some, DRAWS, SEED, any_outputs=True)
    still, fastest = still_and_fastest(some)
    delay = found.delay.double().numpy()[:, 0] * twin.rate
    sizes = {"DRAWS": len(delay), "ENSEMBLE": min(ENSEMBLE, len(delay))}
    sizes |= {"WIDTH": found.offset.shape[1], "LENGTH": math.floor(delay.max()) + 2}
    at_outputs = isinstance(operator, DelayOffset)
    correction = twin.residual.correction
    omitted = (type(correction.second).__name__,) if isinstance(correction, Chain) else ()
    return [
        "".join(f"#define {name} {size}\n" for name, size in sizes.items()),
        "#define AT_OUTPUTS\n" if at_outputs else "",
        constants("DELAY", delay),
        constants("OFFSET", flat(found.offset)),
        constants("SLOPE", flat(found.gain)),
        constants("CENTRE", flat(found.centre)),
        constants("BOTTOM", flat(found.low)),
        constants("TOP", flat(found.high)),
        *([] if at_outputs else [constants("MISSED", flat(found.probability))]),
        *([] if at_outputs else [constants("STILL", still), constants("CATCH", fastest)]),
    ], omitted
