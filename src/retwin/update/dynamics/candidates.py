"""`Candidate`: a form of the discrepancy that was fitted, and how it predicts what was left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.interpolation import delays_tried
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.memory import Memory, times_tried, with_memories
from retwin.update.dynamics.estimation import Estimation, correlation_time
from retwin.update.dynamics.left_out import errors_without, held_out
from retwin.update.dynamics.linearised import HeldOut, Linearised, Point
from retwin.update.dynamics.settings import Dynamics
from retwin.update.dynamics.unknowns import Unknowns

__all__ = ["Candidate", "best_of", "better", "searched", "without_discrepancy"]

STEP = (2.0, 3.0)
"""Least and largest ratio of that variance to the next one: larger steps leave the optimum that the
search follows."""
OPEN, MAX_OPEN = 2, 100
"""Degree of the monomials of all states and commands in each equation, and number of coefficients
above which they are not tried."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fitted form of the discrepancy, its held-out errors, and their mean squares per part.

    The parts are those in time and those at the edges of the domain.
    """

    equations: CorrectedEquations
    memory: Memory | None
    estimation: Estimation
    found: Linearised
    held_out: HeldOut
    squares: tuple[NDArray, NDArray]

    @property
    def opened(self) -> bool:
        """Whether its equations have terms of all variables, which nobody asked for."""
        return self.equations.opened

    @classmethod
    def tested(
        cls,
        equations: CorrectedEquations,
        memory: Memory | None,
        estimation: Estimation,
        found: Linearised,
        parts: Sequence[NDArray],
        far: Sequence[NDArray],
    ) -> Candidate:
        """The candidate, tried on parts (n, T) in time and on those at the edges of the domain."""
        without = held_out(estimation, found, parts)
        alone = errors_without(estimation, found, far)
        squares = (
            _squares(estimation, [without.errors] * len(parts), parts),
            _squares(estimation, alone, far),
        )
        return cls(equations, memory, estimation, found, without, squares)


def without_discrepancy(
    base: StateTwin, observed: Trajectories, unknowns: Unknowns, *, error_steps: int = 2
) -> tuple[Estimation, Linearised]:
    """The fit of the twin itself, and what it leaves open: held there by `absorbed`.

    Parameters
    ----------
    error_steps : int, default 2
        Times that the error of each output is estimated anew where the twin alone is fitted.

    """
    starts = np.tile(unknowns.start[unknowns.free], (len(observed), 1))
    estimation = Estimation(base, observed, unknowns, observed.mask, np.ones(len(base.outputs)))
    found = estimation.linearised(Point(unknowns.mean, starts))
    expected = "a simulation of the commands that is finite"
    got = "one that is not, at the present parameters"
    remedy = "identify the twin first, or choose other starts of its parameters"
    require(found.finite, "twin", expected=expected, got=got, remedy=remedy)
    for _ in range(error_steps):
        estimation = replace(estimation, variance=estimation.power(found.residual))
        found = estimation.minimised(_with_best_delays(estimation, found))
    return hold_confounded(
        replace(estimation, variance=estimation.power(found.residual)), found
    ), found


def hold_confounded(estimation: Estimation, found: Linearised) -> Estimation:
    """The same with combinations of shared coordinates held of which the samples say nothing."""
    # Standard deviation of what the outputs of the twin alone do not determine, in those of the
    # parameters if each were the only one: a discrepancy would determine it by its prior alone.
    combinations, there = estimation.confounded(found) / 1e-3, found.point.shared

    def held(shared: NDArray) -> tuple[NDArray, NDArray]:
        return combinations @ (shared - there), combinations

    return replace(estimation, absorbed=held if len(combinations) else None)


def _with_best_delays(estimation: Estimation, found: Linearised) -> Linearised:
    """The simulation at those dead times from which a step of the other unknowns leaves least."""
    twin, unknowns = estimation.twin, estimation.unknowns

    def rest(at: Linearised, place: int) -> float:
        kept, mean = np.delete(np.arange(unknowns.count), place), unknowns.mean.copy()
        mean[place] = at.point.shared[place]
        own = replace(estimation, unknowns=replace(unknowns, mean=mean).only(kept))
        return own.rest(replace(at, point=Point(at.point.shared[kept], at.point.starts)))

    for parameter in {place for _, place in twin.delay_places}:
        for place in np.flatnonzero(unknowns.matrix[parameter]).tolist():
            tried = [found]
            for value in delays_tried(unknowns.low[place], unknowns.high[place], twin.rate):
                shared = found.point.shared.copy()
                shared[place] = value
                tried.append(estimation.linearised(Point(shared, found.point.starts)))
            found = min(tried, key=lambda at: rest(at, place))
    return found


def searched(
    alone: Estimation,
    point: Point,
    settings: Dynamics,
    visited: NDArray,
    parts: Sequence[NDArray],
    far: Sequence[NDArray],
    progress: Progress,
    *,
    only: Candidate | None = None,
    strongest: float = 100.0,
) -> list[Candidate]:
    """All candidates, the simplest first.

    Parameters
    ----------
    alone : Estimation
        That of the twin without discrepancy; its variances are those of its errors.
    point : Point
        Its optimum.
    settings : Dynamics
        The forms that are tried.
    visited : NDArray
        States (n, T, d_x) over which terms are scaled and compared.
    parts, far : sequence of NDArray
        Parts (n, T) of the samples that are held out in turn, in time and at the edges.
    progress : callable
        Called with the share of the work that is done.
    only : Candidate, optional
        The one whose form alone is tried, with and without a memory.
    strongest : float, default 100.0
        Variance of the error of an effective sample that is assumed first, over that of the samples
        of the twin without discrepancy: a prior so strong that the discrepancy begins near 0.

    """
    tried: list[Candidate] = []
    for number, equations in enumerate(_forms(alone, point, settings, visited)):
        if only is not None and not equations.alike(only.equations):
            continue
        own, found = _follow(equations, None, alone, point, strongest)
        tried.append(Candidate.tested(equations, None, own, found, parts, far))
        if settings.remembers(equations.form):
            slow = _memory(equations, alone, own, found)
            strength = float(np.mean(own.variance / alone.variance))
            own, found = _follow(equations, slow, alone, found.point, strength)
            tried.append(Candidate.tested(equations, slow, own, found, parts, far))
        progress(1 - 0.6 ** (number + 1))
    return tried


def best_of(tried: Sequence[Candidate]) -> Candidate:
    """The simplest candidate whose held-out errors are those of the best one, up to chance."""
    best = tried[_simplest([each.squares for each in tried])]
    without = [each for each in tried if each.memory is None and not each.opened]
    if not without or best in without:
        return best
    other = without[_simplest([each.squares for each in without])]
    return best if better(best, other) else other


def better(candidate: Candidate, other: Candidate, *, decided: float = 2.0) -> bool:
    """Whether a candidate has lower held-out errors in nearly all parts.

    It is asked for what can imitate other errors: a memory is a state more, and with a short time
    constant much like a parameter; and an equation may depend on all variables by chance.

    Parameters
    ----------
    decided : float, default 2.0
        Number of standard errors by which a memory, or commands that are not held between samples,
        must lower the logarithms of held-out errors.

    """
    before, after = (np.log(np.concatenate(each.squares)) for each in (other, candidate))
    change = (after - before)[np.isfinite(after - before)]
    if len(change) < 2:
        return False
    return bool(np.mean(change) < -decided * np.std(change, ddof=1) / np.sqrt(len(change)))


def _with_starts(base: StateTwin, unknowns: Unknowns, point: Point) -> StateTwin:
    """The twin whose parameters start at a point."""
    values = unknowns.offset + unknowns.matrix @ point.shared
    pairs = zip(base.parameters, values.tolist(), strict=True)
    return replace(base, parameters=tuple(each.with_start(value) for each, value in pairs))


def _forms(
    alone: Estimation, point: Point, settings: Dynamics, visited: NDArray
) -> Iterator[CorrectedEquations]:
    """The corrected equations with each form that is tried, at the parameters of a point.

    A form that differs from the one before in no term of these equations is left out. The last one
    has terms of all states and commands in each equation, unless it is known on what they depend.
    """
    unknowns = alone.unknowns
    twin = _with_starts(alone.twin, unknowns, point)
    both = (visited, alone.acting(point))
    terms: list[Parameter] | None = None
    for form in settings.forms:
        made = CorrectedEquations.distinct(twin, form, settings, both, unknowns.matrix)
        if made.coefficients != terms:
            yield made
        terms = made.coefficients
    if settings.library is None or settings.known or twin.learned:
        return
    form = Library(min(settings.library.degree, OPEN), (), False)
    same, made = (
        CorrectedEquations.distinct(twin, form, settings, both, unknowns.matrix, opened=each)
        for each in (False, True)
    )
    if len(same.coefficients) < len(made.coefficients) <= MAX_OPEN:
        yield made


def _with_discrepancy(
    equations: CorrectedEquations, memories: Sequence[Memory], alone: Estimation
) -> Estimation:
    """The estimation of corrected equations with memories."""
    more = [each for memory in memories for each in memory.coefficients]
    unknowns = alone.unknowns.with_coefficients([*equations.coefficients, *more])
    return replace(
        alone,
        twin=with_memories(equations, memories),
        unknowns=replace(unknowns, start=np.append(unknowns.start, [0.0] * len(memories))),
        absorbed=_absorbed(equations, alone),
    )


def _absorbed(
    equations: CorrectedEquations, alone: Estimation
) -> Callable[[NDArray], tuple[NDArray, NDArray]]:
    """What the discrepancy absorbs of the parameters, by all shared coordinates.

    What the twin alone leaves open is held besides.
    """
    first = alone.unknowns.count
    last = first + len(equations.coefficients)

    def absorbed(shared: NDArray) -> tuple[NDArray, NDArray]:
        error, slope = equations.absorbed(shared[first:last])
        slope = np.pad(slope, ((0, 0), (first, len(shared) - last)))
        if alone.absorbed is None:
            return error, slope
        held, by_own = alone.absorbed(shared[:first])
        by_own = np.pad(by_own, ((0, 0), (0, len(shared) - first)))
        return np.append(error, held), np.concatenate([slope, by_own])

    return absorbed


def _memory(
    equations: CorrectedEquations, alone: Estimation, estimation: Estimation, found: Linearised
) -> Memory:
    """The memory from which the fit without one would gain most, by a linear step."""
    states = equations.states
    times = times_tried(alone.observed.steps, alone.twin.rate).tolist()
    # Those of all states in one twin: with weights of 0, none acts on any other.
    whole = _with_discrepancy(equations, [Memory(each, times[0]) for each in states], alone)
    whole = replace(whole, variance=estimation.variance)
    first, starts = estimation.unknowns.count, found.point.starts
    gains: dict[Memory, float] = {}
    for time in times:
        mean = whole.unknowns.mean.copy()
        mean[first + 1 :: 2] = np.log(time / times[0])
        now = replace(whole, unknowns=replace(whole.unknowns, mean=mean))
        shared = np.append(found.point.shared, mean[first:])
        at = now.linearised(Point(shared, starts))
        for i, state in enumerate(states):
            kept = np.append(np.arange(first), first + 2 * i + np.arange(2))
            own = replace(now, unknowns=now.unknowns.only(kept))
            gains[Memory(state, time)] = own.gain(replace(at, point=Point(shared[kept], starts)))
    return max(gains, key=lambda memory: gains[memory])


def _follow(
    equations: CorrectedEquations,
    memory: Memory | None,
    alone: Estimation,
    point: Point,
    strength: float,
    *,
    consistent: float = 0.9,
    max_strengths: int = 30,
) -> tuple[Estimation, Linearised]:
    """The fit whose assumed errors are those that are observed.

    The prior of the discrepancy begins strong, as if errors were large, and becomes weaker step by
    step, which leads the search along.

    Parameters
    ----------
    equations, memory
        The corrected equations.
    alone : Estimation
        That of the twin without discrepancy; its variances are those of its errors.
    point : Point
        Where the search begins; coefficients that it does not have are at their starts.
    strength : float
        The first assumed variance, over that of `alone`.
    consistent : float, default 0.9
        Ratio of the observed to the assumed variance from which they agree.
    max_strengths : int, default 30
        Number of variances at most.

    """
    estimation = _with_discrepancy(equations, [memory] if memory else [], alone)
    power = alone.variance
    begun = np.append(point.shared, estimation.unknowns.mean[len(point.shared) :])
    now = estimation.linearised(Point(begun, point.starts))
    states = len(equations.twin.states)
    for _ in range(max_strengths):
        estimation = replace(estimation, variance=strength * power)
        now = estimation.minimised(now)
        # What a network has in common with parameters is that over the states that it leads to.
        visited = estimation.simulated(now.point)[1][..., :states]
        equations = equations.visiting(visited, estimation.acting(now.point))
        absorbed = _absorbed(equations, alone)
        estimation = replace(estimation, absorbed=absorbed)
        ratio = np.mean(estimation.power(now.residual) / power)
        observed = correlation_time(now.residual) * float(ratio)
        if observed >= consistent * strength:
            break
        strength = float(np.clip(observed, strength / STEP[1], strength / STEP[0]))
    # The last step may have led below what is observed.
    estimation = replace(estimation, variance=max(observed, strength) * power)
    return estimation, estimation.minimised(now)


def _squares(
    estimation: Estimation, errors: Sequence[NDArray], parts: Sequence[NDArray]
) -> NDArray:
    """Mean squares of errors (n, T, d_y), one each for parts (n, T) where all is measured."""
    made = []
    for each, part in zip(errors, parts, strict=True):
        if (estimation.seen & part[..., None]).any(axis=(0, 1)).all():
            made.append(estimation.rms(each, part) ** 2)
    return np.array(made or [0.0])


def _simplest(errors: Sequence[tuple[NDArray, NDArray]]) -> int:
    """The simplest form whose held-out errors are those of the best one, up to chance.

    The errors are mean squares of parts in time and at the edges of the domain, which count alike;
    chance is one standard error of the difference over the parts (Breiman, Friedman, Olshen and
    Stone, Classification and Regression Trees, 1984, section 3.4).
    """
    total = [float(np.nan_to_num(sum(np.mean(each) for each in own), nan=np.inf)) for own in errors]
    best = int(np.argmin(total))
    for i in range(best):
        change = [one - other for one, other in zip(errors[i], errors[best], strict=True)]
        variance = sum(np.var(each, ddof=1) / len(each) for each in change if len(each) > 1)
        if np.isfinite(total[i]) and total[i] - total[best] <= np.sqrt(variance):
            return i
    return best
