"""`fit_state_surrogate`: the state equations of any twin with memory, from simulations of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import floats
from retwin.checks import apart, finite, positive, require, whole
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.serialisation.models import read_model, refusing, save_model
from retwin.twins.commands.samplers import CommandSampler
from retwin.twins.equations.saved_equations import equations_from, equations_of
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.limits import Limits
from retwin.twins.twin import Twin, checked_seed
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.state_surrogate.equations import ChannelScale
from retwin.update.state_surrogate.search import Found, StateSearch, relative_error
from retwin.update.state_surrogate.simulations import (
    MIN_SIMULATIONS,
    Simulations,
    beginning_with,
    check_outputs,
    drawn_parameters,
    first_command,
    samplers_of,
)

KIND = "state_surrogate"
SMALL = 0.5
"""Largest error of a surrogate over the discrepancy of its twin, both root mean squares."""


@dataclass(frozen=True)
class StateSurrogate:
    """Settings of a state surrogate.

    Parameters
    ----------
    states : int or sequence of int
        Numbers of states that are tried, the smallest first; by default from as many as the outputs
        have components on, until more do not lower the error of held-out simulations.
    hidden : int, default 16
        Width of the network inside the equations; twice that is tried where it does not suffice.
    simulations : int, default 100
        Simulations from which it learns, at least 10. Half as many more are held out.
    spread : float, default 1
        Share of each parameter's bounds over which simulations draw it, about its present value,
        above 0 and up to 1; the bounds of the surrogate's parameters are these.
    accuracy : float, default 0.01
        Error of held-out simulations, over the standard deviation of an output, from which on no
        more states are tried.
    allowed : float, default 0.1
        Largest such error that is no error message.
    sufficient : float, default 0
        Share of the twin's discrepancy on measured trajectories; the search ends where the error of
        held-out simulations is below it. By default it goes on until they are predicted no better.
    unknown_start : bool, default False
        Whether the states at the first sample are free, since real records begin anywhere; by
        default they are those with which the twin begins.

    """

    states: int | Sequence[int] = ()
    hidden: int = 16
    simulations: int = 100
    spread: float = 1.0
    accuracy: float = 0.01
    allowed: float = 0.1
    sufficient: float = 0.0
    unknown_start: bool = False

    def __post_init__(self) -> None:
        given = (self.states,) if isinstance(self.states, int) else tuple(self.states)
        orders = tuple(sorted({whole("states", each, at_least=1) for each in given}))
        object.__setattr__(self, "states", orders)
        whole("hidden", self.hidden, at_least=1)
        whole("simulations", self.simulations, at_least=MIN_SIMULATIONS)
        positive("spread", self.spread)
        finite("spread", self.spread, at_most=1.0)
        positive("accuracy", self.accuracy)
        positive("allowed", self.allowed)
        finite("sufficient", self.sufficient, at_least=0.0, at_most=SMALL)


@dataclass(frozen=True, eq=False)
class FittedStateSurrogate:
    """State equations that stand in for a twin, and how well.

    Attributes
    ----------
    twin : StateTwin
        The surrogate. Its parameters are those of the twin, with the bounds over which they were
        drawn; its states x1, x2, ... have no physical meaning.
    figures : dict of str to float
        `states` and `hidden`, the size; `simulations`, from which it learned; of other simulations,
        per output, `rmse_NAME` in its unit, `nrmse_NAME` over its standard deviation, and
        `nrmse_first_NAME` and `nrmse_last_NAME` of the first and the last tenth of the samples;
        `own_NAME` and `discrepancy_NAME`, the root mean square of the error on the user's own
        commands and of the twin's discrepancy there; and `speed`, the time of the twin over that
        of the surrogate.
    history : dict of int to float
        Largest relative error of held-out simulations by the number of states.
    seconds : float
        Duration.
    reason : str
        What the result does not cover; "" for nothing.

    """

    twin: StateTwin
    figures: dict[str, float]
    history: dict[int, float]
    seconds: float
    reason: str

    def save(self, folder: str | Path) -> None:
        """Write the equations and the figures; no code of the twin is needed to read them."""
        about = {name: each for name, each in vars(self).items() if name != "twin"}
        save_model(folder, KIND, {"equations": equations_of(self.twin), **about}, {})

    @classmethod
    def load(cls, folder: str | Path) -> FittedStateSurrogate:
        """Read what `save` wrote.

        Raises InputError if the folder holds no such model or is damaged.
        """
        about, _ = read_model(folder, KIND)
        with refusing(folder, expected="a state surrogate"):
            return cls(
                equations_from(StateTwin, about["equations"]),
                {str(name): finite(name, each) for name, each in about["figures"].items()},
                {int(order): float(error) for order, error in about["history"].items()},
                finite("seconds", about["seconds"]),
                str(about["reason"]),
            )


def fit_state_surrogate(
    twin: Twin,
    commands: CommandSampler | NDArray,
    observed: Trajectories | None = None,
    settings: StateSurrogate = StateSurrogate(),
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> FittedStateSurrogate:
    """Learn the state equations of a twin that has memory, from simulations of it.

    The result is a `StateTwin`: it is differentiable, its parameters can be identified, its
    dynamics corrected (`fit_dynamics`), and its faults inverted. The order is that with the least
    error of held-out simulations. Where the start of a twin depends on its first command, all
    simulations begin with the same one, and the starts of the surrogate are unknown.

    Parameters
    ----------
    twin : Twin
        Any twin. The free parameters of a `ParametricTwin` are parameters of the surrogate;
        simulations draw them. The noise of a stochastic twin is averaged.
    commands : CommandSampler or ndarray, shape (n, T, d_u)
        The distribution of the commands, such as that of a case, or your own commands. Of your own
        commands, those that `sampler_from` draws and pieces of these are simulated, and the
        surrogate is compared with the twin on them.
    observed : Trajectories, optional
        Measured trajectories, whose commands are treated as your own. Where the error of the
        surrogate on them is not small compared with the discrepancy of the twin, that is an error.
    settings : StateSurrogate
        Size, simulations, and accuracy.
    seed : int
        Of commands, parameters and first weights, at least 0.
    progress : callable, optional
        Called with the share of the work that is done.

    Returns
    -------
    FittedStateSurrogate
        Its `twin` is a `StateTwin`.

    Raises
    ------
    InputError
        Commands at another rate or of other channels, too short or too many failing simulations, an
        output that never changes; and a surrogate that does not follow the twin: on other
        simulations, or on your own commands.

    """
    began = time.perf_counter()
    seed, report = checked_seed(seed), progress or (lambda _: None)
    free = drawn_parameters(twin, settings.spread)
    samplers, own = samplers_of(twin, commands, observed)
    first = first_command(twin, samplers)
    own = [beginning_with(first, each) for each in own]
    simulations, rng = Simulations(twin, free, samplers, first), np.random.default_rng(seed)
    training = simulations.made(settings.simulations, rng)
    held_out, test = (simulations.made(settings.simulations // 4, rng) for _ in range(2))
    check_outputs(training)
    expected = None if observed is None else twin.simulate(own[-1], seed=0)
    report(0.2)
    search = StateSearch(
        orders=settings.states,  # type: ignore[arg-type]  # a tuple
        hidden=settings.hidden,
        accuracy=settings.accuracy,
        enough=_enough(settings.sufficient, training, expected, observed),
    )
    found, history = search.run(
        training, held_out, seed=seed, progress=lambda share: report(0.2 + 0.7 * share)
    )
    unknown = settings.unknown_start or first is not None
    made = _twin_of(twin, found, free, training, own, unknown_start=unknown)
    figures = {
        "states": float(found.order),
        "hidden": float(len(found.equations.arrays["b"])),
        "simulations": float(len(training)),
    }
    figures |= _test(made, test, found, simulations.seconds, settings.allowed)
    if expected is not None:
        figures |= _compare(made, expected, observed, settings.allowed)
    else:
        for commands in own:
            figures |= _compare(made, twin.simulate(commands, seed=0), None, settings.allowed)
    report(1.0)
    duration = time.perf_counter() - began
    return FittedStateSurrogate(made, figures, history, duration, simulations.reason)


def _twin_of(
    twin: Twin,
    found: Found,
    free: tuple[Parameter, ...],
    training: Trajectories,
    own: Sequence[NDArray],
    *,
    unknown_start: bool,
    margin: float = 0.25,
) -> StateTwin:
    """The surrogate, whose limits are those of the commands in simulations, with a margin.

    Parameters
    ----------
    margin : float, default 0.25
        How far beyond the commands of the simulations the surrogate takes commands, in widths of
        their range; other draws of the same sampler are within.

    """
    simulated, parameters = _split(training, len(twin.inputs))
    low, high = (
        make([make(each, axis=(0, 1)) for each in (simulated, *own)], axis=0)
        for make in (np.min, np.max)
    )
    low, high = low - margin * (high - low), high + margin * (high - low)
    limits = getattr(twin, "limits", None)
    if limits is not None:
        low, high = np.maximum(low, limits.low), np.minimum(high, limits.high)
    limits = Limits(floats(low), floats(high), "refuse" if limits is None else limits.outside)

    def made(starts: NDArray | None) -> StateTwin:
        return found.equations.twin(twin, free, limits, starts)

    known = made(None)
    if not unknown_start:
        return known
    given = dict(zip((each.name for each in free), parameters.T, strict=True))
    visited = known.hidden(simulated, given)
    return made(np.stack([visited.min(axis=(0, 1)), visited.max(axis=(0, 1))]))


def _split(made: Trajectories, width: int) -> tuple[NDArray, NDArray]:
    """Commands (n, T, d_u) and parameters (n, k) of simulations."""
    return made.commands[..., :width], made.commands[:, 0, width:]


def _test(
    made: StateTwin, test: Trajectories, found: Found, seconds: float, allowed: float
) -> dict[str, float]:
    """Errors on simulations of which nothing was learned, and the ratio of speeds.

    Raises InputError where an error is larger than allowed.
    """
    commands, parameters = _split(test, len(made.inputs))
    given = dict(zip((each.name for each in made.parameters), parameters.T, strict=True))
    values, simulate = made.values(given, len(test)), made.steps().run
    simulate(commands, values)  # which compiles it
    began = time.perf_counter()
    error = simulate(commands, values)[0] - test.observed
    duration = (time.perf_counter() - began) / commands[..., 0].size
    tenth, deviation = max(1, test.steps // 10), found.equations.outputs.deviation
    whole, first, last = (
        relative_error(error[:, part], test.mask[:, part], deviation)
        for part in (slice(None), slice(tenth), slice(-tenth, None))
    )
    worst, names = int(np.argmax(whole)), made.outputs.names
    bound, size = apart(allowed, whole[worst])
    require(
        whole[worst] <= allowed,
        "twin",
        expected=f"simulations that a state surrogate follows to {bound} of the standard "
        "deviation of each output",
        got=f"an error of {size} for {names[worst]} ({first[worst]:.3g} in the first "
        f"tenth of the samples, {last[worst]:.3g} in the last)",
        remedy="give more simulations, a wider network (hidden), a smaller spread of the "
        "parameters, all under [state_surrogate] of a case, or shorter trajectories; chaos, "
        "impacts, switches and dead time can hardly be learned: write the equations as a "
        "StateTwin (docs/twins.md#states), or correct the outputs of the twin as it is, without "
        "dynamics",
    )
    columns = {"rmse": whole * deviation, "nrmse": whole, "nrmse_first": first, "nrmse_last": last}
    return {
        f"{figure}_{name}": float(each)
        for figure, row in columns.items()
        for name, each in zip(names, row, strict=True)
    } | {"speed": seconds / max(duration, 1e-12)}


def _enough(
    share: float,
    training: Trajectories,
    expected: Trajectories | None,
    observed: Trajectories | None,
) -> float:
    """The relative error of simulations that is a share of the twin's discrepancy, 0 if unknown."""
    if expected is None or observed is None or not share:
        return 0.0
    seen = observed.mask & expected.mask
    used = training.mask.all(axis=2)
    deviation = ChannelScale.of(training.observed[used][None]).deviation
    sizes = relative_error(observed.observed - expected.observed, seen, deviation)
    return share * float(sizes[seen.any(axis=(0, 1))].min(initial=np.inf))


def _compare(
    made: StateTwin, expected: Trajectories, observed: Trajectories | None, allowed: float
) -> dict[str, float]:
    """Errors on the user's own commands, at the present values of the parameters.

    `expected` are the simulations of the twin. Raises InputError where an error is not small
    compared with the discrepancy of the twin; without measurements, where it is larger than
    allowed.
    """
    error = made.simulate(expected.commands, seed=0).observed - expected.observed
    seen, ones = expected.mask, np.ones(len(made.outputs))
    if observed is None:
        compared, largest = expected.observed - expected.observed.mean(axis=(0, 1)), allowed
        what = "the standard deviation of the output"
    else:
        compared, largest, seen = observed.observed - expected.observed, SMALL, seen & observed.mask
        what = "the twin's discrepancy there"
    errors, sizes = (relative_error(each, seen, ones) for each in (error, compared))
    worst, names = int(np.argmax(errors - largest * sizes)), made.outputs.names
    bound, size = apart(largest * sizes[worst], errors[worst])
    unit = "" if made.outputs.units[worst] == "1" else f" {made.outputs.units[worst]}"
    require(
        errors[worst] <= largest * sizes[worst],
        "commands" if observed is None else "observed",
        expected=f"an error of the surrogate on these commands of at most {bound}{unit} for "
        f"{names[worst]}, {largest:g} of {what}",
        got=f"{size}{unit}",
        remedy="give more simulations, a wider network (hidden) or a smaller spread of the "
        "parameters under [state_surrogate] of a case, so that the surrogate is more accurate",
    )
    figures = {f"own_{name}": float(each) for name, each in zip(names, errors, strict=True)}
    if observed is None:
        return figures
    sized = zip(names, sizes, strict=True)
    return figures | {f"discrepancy_{name}": float(each) for name, each in sized}
