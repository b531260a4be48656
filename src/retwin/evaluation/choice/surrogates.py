"""`stand_in`: a surrogate of a twin, checked against the twin; else the twin itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from retwin.catalog import SURROGATE_MODES
from retwin.checks import one_of
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.nets.networks import LSTM, MLP, Network, StateSpace
from retwin.nets.training import Training
from retwin.progress import Progress
from retwin.twins.collected import SimulationError
from retwin.twins.commands.range import CommandRange
from retwin.twins.commands.record_sampler import sampler_from
from retwin.twins.commands.samplers import CommandSampler, RecordedSampler
from retwin.twins.twin import Twin
from retwin.update.corrected import generate
from retwin.update.dynamics import state_names
from retwin.update.state_surrogate import StateSurrogate, fit_state_surrogate
from retwin.update.surrogate import Surrogate, fit_surrogate

SLOW = 1.0
"""Duration in s of a simulation of one record from which on a surrogate pays. It needs hundreds of
simulations and minutes of training, and candidates need some ten of each record."""
SMALL = 0.5
"""Largest error of a surrogate on the commands of the records, over the discrepancy of the twin
there, both root mean squares: of their sum it is then a tenth."""
OTHERS: tuple[Network, ...] = (StateSpace(), LSTM(64))
"""Networks that are tried where the first one does not follow the twin: slow and integrating twins
need states, others a long memory."""


@dataclass(frozen=True)
class SurrogateSettings:
    """How the simulations for a surrogate are made, and how it is trained.

    Parameters
    ----------
    mode : {"auto", "on", "off"}
        Whether a surrogate stands in for the twin: if the twin is slow, always, or never.
    sampler : CommandSampler, optional
        The distribution of commands; by default like those of the records.
    simulations : int
        Number of simulations.
    network : Network
        The network that is tried first.
    training : Training, optional
        Its training; by default that of the network.
    simulated : Trajectories, optional
        Simulations of the twin, in place of those that would be made.
    equations : StateSurrogate, optional
        How state equations are learned that stand in for a twin without such, however fast it is;
        by default no equations are.

    """

    mode: str = "auto"
    sampler: CommandSampler | None = None
    simulations: int = 400
    network: Network = MLP()  # noqa: RUF009 - frozen
    training: Training | None = None
    simulated: Trajectories | None = None
    equations: StateSurrogate | None = None

    def __post_init__(self) -> None:
        one_of("surrogate", self.mode, SURROGATE_MODES)


@dataclass(frozen=True, eq=False)
class StandIn:
    """What corrections are fitted to.

    Attributes
    ----------
    twin : Twin
        The twin itself, a `Surrogate`, or a `StateTwin` that was learned.
    text : str
        What was decided, in a sentence; "" for the twin itself.
    figures : dict of str to float
        Errors of a surrogate, see `Surrogate.fitted` and `FittedStateSurrogate`.

    """

    twin: Twin
    text: str = ""
    figures: dict[str, float] = field(default_factory=dict)


def stand_in(
    twin: Twin,
    records: Trajectories,
    settings: SurrogateSettings = SurrogateSettings(),
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> StandIn:
    """The twin that corrections are fitted to: the twin itself, or a surrogate of it.

    Parameters
    ----------
    twin : Twin
        Any twin.
    records : Trajectories
        Measured outputs with the commands for which the surrogate must follow the twin.
    settings : SurrogateSettings
        Whether there is a surrogate, and how it is trained.
    seed : int
        Of commands and weights.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    StandIn
        The twin or a surrogate, and what was decided.

    Raises
    ------
    InputError
        No network follows the twin on the commands of the records: its error is not small compared
        with the discrepancy of the twin.

    """
    if settings.mode == "off" or isinstance(twin, Surrogate):
        return StandIn(twin)
    if settings.equations is not None:
        if state_names(twin):
            return StandIn(twin)
        commands, how = settings.sampler or records.commands, settings.equations
        found = fit_state_surrogate(twin, commands, records, how, seed=seed, progress=progress)
        errors = (f"{found.figures[f'own_{name}']:.3g} in {name}" for name in twin.outputs.names)
        text = (
            f"The twin shows no state equations. Others with {found.figures['states']:.0f} states "
            "stand in for it, learned from simulations; on the measured commands their RMS error "
            f"is {', '.join(errors)}"
        )
        return StandIn(found.twin, text, found.figures)
    if settings.mode == "auto":
        begun = time.perf_counter()
        twin.simulate(records.commands[:1].astype(np.float64), seed=0)
        if time.perf_counter() - begun < SLOW:
            return StandIn(twin)
    report = progress or (lambda _: None)
    made, text = settings.simulated, ""
    if made is None:
        made, text = _simulations_for(twin, records, settings, seed, lambda s: report(0.5 * s))
    networks = [settings.network, *OTHERS]
    failures = []
    for i, network in enumerate(networks):
        training = settings.training if i == 0 else None
        surrogate = fit_surrogate(
            made,
            network,
            seed=seed,
            training=training,
            progress=lambda s, i=i: report(0.5 + 0.5 * (i + s) / len(networks)),  # type: ignore[misc]
        )
        failure = _failure(surrogate, twin, records)
        if not failure:
            report(1.0)
            return StandIn(surrogate, text, surrogate.fitted.figures if surrogate.fitted else {})
        failures.append(f"{type(network).__name__}: {failure}")
    raise InputError(
        "surrogate",
        expected=f"a surrogate whose error is at most {SMALL:g} times the discrepancy of the twin "
        "on the commands of the records",
        got="; ".join(failures),
        remedy="use the twin itself (--surrogate off), or train on more simulations, for longer, "
        "or with another network",
    )


def _failure(surrogate: Surrogate, twin: Twin, records: Trajectories) -> str:
    """The error of a surrogate that is not small compared with the discrepancy; "" if it is."""
    try:
        nominal = twin.simulate(records.commands.astype(np.float64), seed=0).nominal
    except (InputError, SimulationError):  # the surrogate is all there is for these commands
        return ""
    error = surrogate.predict(records.commands) - nominal
    for channel, name in enumerate(records.outputs.names):
        seen = records.mask[..., channel]
        if not seen.any():
            continue
        sizes = [
            float(np.sqrt(np.mean(np.square(each[..., channel][seen], dtype=np.float64))))
            for each in (error, records.observed - nominal)
        ]
        if sizes[0] > SMALL * sizes[1]:
            return f"{sizes[0]:.4g} in {name} where the twin differs by {sizes[1]:.4g}"
    return ""


def _simulations_for(
    twin: Twin,
    records: Trajectories,
    settings: SurrogateSettings,
    seed: int,
    progress: Progress | None = None,
) -> tuple[Trajectories, str]:
    """Healthy simulations of a twin, which contain what the commands of the records contain.

    Where the sampler does not draw such commands, half as many are added that are like those of
    the records, and as many parts of these.

    Returns
    -------
    Trajectories, str
        The simulations, and what was added, in a sentence.

    """
    half = max(1, settings.simulations // 2)

    def drawn(sampler: CommandSampler, count: int) -> Trajectories:
        healthy = SimpleNamespace(sampler=sampler, faults={HEALTHY: None}, classes=(HEALTHY,))
        return generate(twin, healthy, per_class=count, seed=seed, progress=progress)

    made, outside = [], ""
    if settings.sampler is not None:
        own = drawn(settings.sampler, settings.simulations)
        contained = CommandRange.of(own.commands, own.rate)
        alike = (records.inputs, records.rate) == (twin.inputs, twin.rate)
        outside = contained.outside(records.commands, own.rate, twin.inputs) if alike else ""
        if not outside:
            return own, ""
        made.append(own)
    similar = sampler_from(records.commands, records.rate, limits=getattr(twin, "limits", None))
    duration = min(similar.duration, records.steps / records.rate)
    parts = RecordedSampler(records.commands, records.rate, duration)
    made += [drawn(each, half) for each in (similar, parts)]
    text = (
        f"The sampler of the case does not draw the real commands: {outside}. {2 * half} "
        "simulations of commands like these were added"
    )
    return _together(made), text if outside else ""


def _together(sets: Sequence[Trajectories]) -> Trajectories:
    """Several sets as one, all as long as the longest."""
    steps = max(each.steps for each in sets)
    return Trajectories.concatenate([each.padded(steps) for each in sets])
