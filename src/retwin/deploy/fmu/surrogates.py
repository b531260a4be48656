"""Surrogates as C99, alone or with a residual: of each sample, or of each segment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import given, require
from retwin.compiler import c_source
from retwin.deploy.actuator.draws import causal_part, drawn, still_and_fastest
from retwin.deploy.fmu.description import variables_of
from retwin.deploy.fmu.networks import CNetwork, c_network, dense_weights, flat, weights_of
from retwin.deploy.fmu.text import Text, constants
from retwin.nets.mixtures import FLOOR
from retwin.nets.networks import Network
from retwin.twins.twin import checked_commands
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive, Chain, DelayOffset, before_sensor, sensor_of
from retwin.update.residual import Residual, ResidualModel, SequenceResidual
from retwin.update.surrogate import Surrogate

DRAWS = 1024
"""Draws of z from which the seed of an instance selects one."""
ENSEMBLE = 64
"""Draws that each FMU simulates beside its own, for means and quantiles."""
SEED = 0
"""Of the draws: the same twin gives the same bytes."""


def surrogate_text(twin: Surrogate | CorrectedTwin, commands: NDArray | None = None) -> Text:
    """A surrogate, with its residual model where it has one, as C text.

    Parameters
    ----------
    twin : Surrogate or CorrectedTwin
        What is exported.
    commands : NDArray, optional
        (n, T, d_u), for a residual with one z per segment, see `segment_parts`.

    Raises
    ------
    InputError
        A part that depends on later samples, or that does not exist in C.

    """
    surrogate = twin if isinstance(twin, Surrogate) else twin.surrogate
    got = "a twin in place of a surrogate, which is no network"
    remedy = "fit a surrogate of it, or learn its state equations: fit_state_surrogate"
    _refuse(not isinstance(surrogate, Surrogate), got, remedy)
    inputs, outputs = len(surrogate.inputs), len(surrogate.outputs)
    network = c_network(surrogate.config, inputs, outputs)
    first, limits, ranged = _commands(surrogate)
    networks = [network]
    parts = [
        network.defined("SURROGATE"),
        f"#define REMEMBERED {network.memory}\n#define PERIOD {1 / surrogate.rate!r}\n",
        constants("SURROGATE_WEIGHTS", weights_of(surrogate.config, surrogate.network), "float"),
        constants("FIRST", first),
        *_units(BEFORE=surrogate.before, AFTER=surrogate.after),
        *ranged,
    ]
    before: list[str] = []
    omitted: tuple[str, ...] = ()
    if isinstance(twin, CorrectedTwin) and isinstance(twin.residual, ResidualModel):
        before, omitted = segment_parts(twin, commands)
        before.append(f"#define REMEMBERED {network.memory}\n")
        parts += [c_source(__package__, "actuators.c")]
    elif isinstance(twin, CorrectedTwin):
        encoder, texts = _residual_parts(_per_sample(twin.residual, twin.rate))
        networks.append(encoder)
        parts += texts
    kinds = sorted({each.kind.upper() for each in networks})
    sizes = {"NU": inputs, "NI": inputs, "NY": outputs, "NV": 1 + 2 * inputs + 5 * outputs}
    sizes |= {"WIDEST": max(each.widest for each in networks)}
    defined = "".join(f"#define {name} {size}\n" for name, size in sizes.items())
    defined += "".join(f"#define USES_{kind}\n" for kind in kinds)
    shared = ["variables.c", "networks.c", *(["random.c"] if twin is not surrogate else [])]
    source = [defined, *before, c_source(__package__, *shared), *parts]
    source.append(c_source(__package__, "surrogate.c"))
    channels = (surrogate.inputs, surrogate.outputs)
    return Text(
        "\n".join(source),
        variables_of(*channels, first, (), (), limits=limits, ranged=bool(ranged)),
        surrogate.rate,
        "" if isinstance(twin, Surrogate) else twin.case,
        omitted=omitted,
    )


def _commands(
    surrogate: Surrogate,
) -> tuple[list[float], list[tuple[float, float]] | None, list[str]]:
    """Commands before any are given, those of the training, and what is outside as C text."""
    trained, mean = surrogate.trained, surrogate.before.mean.double().numpy()
    if trained is None:
        return mean.tolist(), None, []
    low, high, speed = trained.bounds
    arrays = {"LEAST": low, "GREATEST": high, "FASTEST": speed / surrogate.rate}
    text = ["#define RANGED", *(constants(name, values) for name, values in arrays.items())]
    limits = list(zip(trained.low, trained.high, strict=True))
    return np.clip(mean, trained.low, trained.high).tolist(), limits, text


def _refuse(wrong: bool, got: str, remedy: str) -> None:
    expected = "a twin whose outputs depend on past commands alone, in parts that exist in C"
    require(not wrong, "twin", expected=expected, got=got, remedy=remedy)


def _per_sample(residual: Residual, rate: float) -> SequenceResidual:
    """The residual model, which must have one z per sample that is added."""
    other = "fit Additive with a SequenceMixture, or the state equations (retwin fit --dynamics)"
    correction = residual.correction
    assert isinstance(residual, SequenceResidual)
    sensor = sensor_of(correction)
    if sensor is not None:
        every = 0 if sensor.period is None else sensor.timing(rate)[0]
        reason = "the errors of its samples have no C text"
        if every > 1:
            reason = "a record joins sampled values by straight lines: it depends on the next one"
        remedy = "fit the correction without SampledSensor, at the rate of the sensor"
        _refuse(every > 0, f"{_named(correction)}: {reason}", remedy)
        correction = before_sensor(correction)
    got = f"{_named(correction)}, an operator that has no C text"
    _refuse(type(correction) is not Additive, got, other)
    return residual


def _named(correction: object) -> str:
    """The operators of a correction by their names."""
    if isinstance(correction, Chain):
        return f"Chain({_named(correction.first)}, {_named(correction.second)})"
    return type(correction).__name__


def _units(**modules: object) -> list[str]:
    """Means and scales of standardisations, by the name of each."""
    return [
        constants(f"{name}_{what.upper()}", flat(getattr(module, what)))
        for name, module in modules.items()
        for what in ("mean", "scale")
    ]


def _residual_parts(residual: SequenceResidual) -> tuple[CNetwork, list[str]]:
    """The ensemble of a residual model: its network, and its C text."""
    density = residual.density
    channels = len(residual.inputs) + len(residual.outputs)
    encoder = c_network(density.network, channels, density.features)
    weights = [_member_weights(density.network, each) for each in residual.members]
    sizes = {"MEMBERS": len(weights), "PER_MEMBER": len(weights[0]), "ENCODED": encoder.memory}
    sizes |= {"FEATURES": density.features, "COMPONENTS": density.components}
    numbers = {"FLOOR": FLOOR, "SQRT2": float(np.sqrt(2.0))}
    persistence = flat(residual.persistence)
    defined = "".join(f"#define {name} {value!r}\n" for name, value in (sizes | numbers).items())
    return encoder, [
        encoder.defined("ENCODER"),
        defined,
        constants("ENCODER_WEIGHTS", np.concatenate(weights), "float"),
        *_units(PAST=residual.before),
        constants("SHIFT", flat(residual.shift)),
        constants("SCALE", flat(residual.scale)),
        constants("TRUST", flat(residual.trust)),
        constants("SPREAD", flat(residual.spread)),
        constants("LIMIT", flat(residual.bounds)),
        constants("PERSISTENCE", np.concatenate([persistence[:1], persistence])),
    ]


def _member_weights(config: Network, member: Any) -> NDArray:
    """The weights of a network of the ensemble, those of its mixture last."""
    parts = weights_of(config, member.encoder[0]), dense_weights(member.heads[0].linear)
    return np.concatenate(parts)


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
