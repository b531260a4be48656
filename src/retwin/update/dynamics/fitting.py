"""`fit_dynamics`: the discrepancy inside a twin's state equations, from outputs alone."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from retwin.checks import require
from retwin.data.measured import unmeasured
from retwin.data.quality.check import doubtful
from retwin.data.quality.copies import distinct_records
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import checked_stride
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.sensor_limits import describe_limits, limit_equations
from retwin.update.dynamics.between_samples import chosen
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.memory import Memory
from retwin.update.dynamics.discrepancy.network import TanhNetwork
from retwin.update.dynamics.estimation import Estimation, root
from retwin.update.dynamics.filter.noise import fit_noise, folds, widening
from retwin.update.dynamics.left_out import dependent_errors
from retwin.update.dynamics.linearised import HeldOut, Linearised, Point
from retwin.update.dynamics.settings import Dynamics
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of
from retwin.update.score_covariance import NORMAL_95
from retwin.workers.threads import one_thread

__all__ = ["FittedDynamics", "assembled", "fit_dynamics"]


@dataclass(frozen=True, eq=False)
class FittedDynamics:
    """A twin with corrected dynamics, and what was learned.

    Attributes
    ----------
    twin : DynamicsTwin
        The corrected twin.
    parameters, errors : dict of str to float
        The twin's own parameters theta, and their standard errors, which allow for errors of the
        outputs that are correlated within records, blocks of time, and the parts that are held out;
        infinite for those that the record does not determine. They hold for the chosen form of the
        discrepancy, in which a parameter takes what it explains: its value is then that of the
        equations beside the terms.
    intervals : dict of str to tuple of float
        Their 95 % intervals, by Student's t distribution where few blocks give the errors.
    correlations : dict of (str, str) to float
        Posterior correlations of the parameters, with each other and with the coefficients of the
        terms; the strongest first. Those of parameters that are not determined are left out.
    terms : dict of str to float
        The root mean square of each term over the calibration record, in that of the time
        derivative of its state; the largest first.
    figures : dict of str to float
        `rms_before` and `rms_after` of free simulation over the calibration record, in output units
        (relative to each output's standard deviation where units differ), `held_out`, that of
        blocks left out in time, `held_out_edges`, that of the ends of the range of each state and
        command if they are left out, `widening_NAME`, of the bands of each output, and `strength`,
        the assumed variance of errors over that of the twin.
    form : Library or TanhNetwork
        The chosen form of the discrepancy.
    seconds : float
        Duration.
    reason : str
        What the result does not cover: parameters and starts that are at bounds, parameters
        that the record does not determine, measurements that are doubtful, and trajectories that
        are copies of others, which count once.

    """

    twin: DynamicsTwin
    parameters: dict[str, float]
    errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    correlations: dict[tuple[str, str], float]
    terms: dict[str, float]
    figures: dict[str, float]
    form: Library | TanhNetwork
    seconds: float
    reason: str

    def strongest(self, parameter: str) -> tuple[str, float] | None:
        """What a parameter is most correlated with, and how much; None where nothing is known."""
        for pair, value in self.correlations.items():
            if parameter in pair:
                return pair[pair[0] == parameter], value
        return None


@one_thread()
def fit_dynamics(
    twin: StateTwin | ParametricTwin,
    observed: Trajectories,
    settings: Dynamics = Dynamics(),  # noqa: B008 - frozen
    *,
    progress: Progress | None = None,
) -> FittedDynamics:
    """Learn what a twin's state equations lack, from measured outputs alone.

    The parameters theta of the twin, the coefficients psi of a discrepancy inside its state
    equations, and the unknown starts of the states are estimated together on free simulation.
    Coefficients have a Gaussian prior about 0, and theta has none, so that what theta can explain
    is not explained by the discrepancy. The assumed error variance, which sets the strength of that
    prior, is the one that is observed. Process and measurement noise then maximise the likelihood
    of an extended Kalman filter, and bands are scaled to hold held-out blocks.

    Parameters
    ----------
    twin : StateTwin or ParametricTwin
        The equations, with their parameters or with those alone that are to be free; best after
        `identify`, since the search begins there.
    observed : Trajectories
        Healthy calibration trajectories with commands; masked samples are not used. Where an
        output stays at exactly its lowest or highest value, that is the limit of its sensor, and
        one of the twin's output.
    settings : Dynamics
        The form of the discrepancy.
    progress : callable, optional
        Called with the share of the work that is done.

    Returns
    -------
    FittedDynamics
        Its `twin` is a `DynamicsTwin`.

    Raises
    ------
    InputError
        A twin that is no `StateTwin`, other channels or another rate, no healthy trajectory, too
        few samples, an output that was never measured, an unknown state, or a twin whose simulation
        is not finite.

    Warns
    -----
    UserWarning
        A parameter, or the start of a state, is at its bound, the record does not determine a
        parameter, trajectories are copies, or an output never changes or holds a value that seems
        to stand for a missing measurement.

    """
    began = time.perf_counter()
    base, free, values = state_twin_of(twin)
    checked_stride(base, observed, None, "observed")
    limits = limits_of(observed)
    base = limit_equations(base, limits)
    once = distinct_records(np.where(observed.mask, observed.observed, np.nan))
    copies = len(observed) - len(once)
    again = f"{copies} of {len(observed)} trajectories are copies and count once" * bool(copies)
    observed = observed[once]
    report = progress or (lambda share: None)
    unknowns = unknowns_of(base, free, values)
    if settings.held:
        unknowns = unknowns.only(np.arange(0))
    _check_samples(observed, unknowns.count + len(unknowns.free) + settings.folds)
    parts = folds(observed.mask, settings.folds)
    alone, fitted, best = chosen(base, observed, unknowns, settings, parts, report)
    power = alone.variance
    equations, memory = best.equations, best.memory
    estimation, found, held_out = best.estimation, best.found, best.held_out
    corrected = equations.states, (memory.speed(equations) if memory else equations.domain.speed)
    moves = _trusted(estimation, found.point, held_out, parts)
    made = assembled(estimation, found, *corrected, parts, moves)
    made = replace(made, widening=widening(made, estimation, held_out))
    report(1.0)
    unknown = estimation.undetermined(found)[: unknowns.count]
    if alone.absorbed is not None:
        unknown |= (alone.absorbed(fitted.point.shared)[1] != 0).any(axis=0)
    own = _notes(estimation, found.point, unknown)
    known = unmeasured(observed), doubtful(observed), describe_limits(base.outputs.names, limits)
    notes = "; ".join(filter(None, [own, *known, again]))
    if notes:
        warnings.warn(notes, stacklevel=2)
    k, count = unknowns.count, len(found.point.shared)
    covariance = estimation.covariance(found)[:count, :count]
    deviation = np.sqrt(np.maximum(np.diag(covariance), held_out.variance))
    apart, factor = dependent_errors(estimation, found, k)
    half = np.maximum(NORMAL_95 * deviation[:k], factor * apart)
    error = np.maximum(deviation[:k], apart)
    half[unknown] = error[unknown] = np.inf
    theta = found.point.shared[:k]
    ends = zip((theta - half).tolist(), (theta + half).tolist(), strict=True)
    return FittedDynamics(
        twin=made,
        parameters=dict(zip(unknowns.names, theta.tolist(), strict=True)),
        errors=dict(zip(unknowns.names, error.tolist(), strict=True)),
        intervals=dict(zip(unknowns.names, ends, strict=True)),
        correlations=_correlations(estimation.unknowns.names, covariance, unknown),
        terms=_sizes(equations, memory, estimation, found.point),
        figures={
            "rms_before": alone.rms(fitted.residual),
            "rms_after": estimation.rms(found.residual),
            "held_out": estimation.rms(held_out.errors),
            "held_out_edges": float(np.sqrt(np.mean(best.squares[1]))),
            **{
                f"widening_{name}": float(factor)
                for name, factor in zip(base.outputs.names, made.widening, strict=True)
            },
            "strength": float(np.mean(estimation.variance / power)),
        },
        form=equations.form,
        seconds=time.perf_counter() - began,
        reason=notes,
    )


def _check_samples(observed: Trajectories, parameters: int) -> None:
    """Refuse an output that was never measured, and fewer samples than parameters."""
    names = observed.outputs.names
    missing = [name for i, name in enumerate(names) if not observed.mask[..., i].any()]
    expected = "measured samples of every output"
    got = f"none of {', '.join(missing)}"
    remedy = "leave that output out of the twin and of the record, since its noise is unknown"
    require(not missing, "observed", expected=expected, got=got, remedy=remedy)
    expected = "more measured samples than parameters"
    got = str(observed.mask.sum())
    remedy = "give more or longer trajectories, or free fewer parameters"
    require(observed.mask.sum() > parameters, "observed", expected=expected, got=got, remedy=remedy)


def assembled(
    estimation: Estimation,
    found: Linearised,
    corrected: tuple[str, ...],
    speed: NDArray,
    parts: Sequence[NDArray],
    moves: NDArray,
) -> DynamicsTwin:
    """The twin of an estimation as a distribution, its bands not yet calibrated.

    Parameters
    ----------
    estimation, found
        The equations, and their optimum.
    corrected : tuple of str
        The states whose equations may be wrong, so that they have process noise.
    speed : NDArray
        (d_x,), see `Domain`.
    parts : sequence of NDArray
        K parts (n, T) of the samples, by which the noise is fitted.
    moves : NDArray
        (K, k), by how much the shared coordinates differ without each part.

    """
    unknowns = estimation.unknowns
    start, deviation = unknowns.start.copy(), np.zeros(len(unknowns.start))
    start[unknowns.free] = found.point.starts.mean(axis=0)
    deviation[unknowns.free] = found.point.starts.std(axis=0)
    values = unknowns.offset + unknowns.matrix @ found.point.shared
    by_free = np.eye(len(start))[:, unknowns.free]
    factor = block_diag(unknowns.matrix, by_free) @ root(estimation.covariance(found))
    states = estimation.simulated(found.point)[1]
    names = [each.name for each in estimation.twin.states]
    indices = [names.index(name) for name in corrected]
    made = DynamicsTwin(
        estimation.twin,
        np.concatenate([values, start]),
        factor,
        deviation,
        np.zeros(len(start)),
        np.zeros(len(start)),
        np.zeros(len(start)),
        estimation.power(found.residual),
        np.ones(len(estimation.twin.outputs)),
        np.zeros(len(estimation.twin.outputs)),
        Domain.visited(states, estimation.commands, speed),
        corrected,
        estimation.observed.emulated,
    )
    by_values = np.pad(moves @ unknowns.matrix.T, ((0, 0), (0, len(start))))
    return fit_noise(made, estimation.observed, indices, parts, by_values)


def _trusted(
    estimation: Estimation, found: Point, held_out: HeldOut, parts: Sequence[NDArray]
) -> NDArray:
    """The moves (K, k) of the estimates without each part; 0 where they show no noise.

    Either they are no linear step, so that the errors of the simulation itself differ from those of
    the linear step. Or the other parts leave open more than the errors of this one: without a
    transient, what it alone determines may be anything, and would seem to be noise.
    """
    moves = np.zeros(held_out.moves.shape)
    share = estimation.seen * held_out.variances / estimation.power(estimation.residual(found))
    for k, (part, move) in enumerate(zip(parts, held_out.moves, strict=True)):
        if share[part].sum() > estimation.seen[part].sum():
            continue
        residual = estimation.residual(Point(found.shared + move, found.starts))[part]
        linear = held_out.errors[part]
        # Ratio of the errors of a simulation to those of a linear step, from which on the step is
        # none.
        if np.sum(residual**2) <= 1.5**2 * np.sum(linear**2):
            moves[k] = move
    return moves


def _notes(estimation: Estimation, found: Point, unknown: NDArray) -> str:
    """Which parameters (k,) are unknown, and what is at a bound."""
    unknowns, k = estimation.unknowns, len(unknown)
    own = [f"start_{estimation.twin.states[i].name}" for i in unknowns.free]
    values = np.vstack([np.tile(found.shared[:k], (len(found.starts), 1)).T, found.starts.T])
    low, high = (
        np.append(each[:k], each[unknowns.count :])[:, None]
        for each in (unknowns.low, unknowns.high)
    )
    at = (values <= low) | (values >= high)
    names = [name for name, each in zip([*unknowns.names[:k], *own], at, strict=True) if each.any()]
    free = [name for name, each in zip(unknowns.names, unknown, strict=False) if each]
    groups = {"at a bound, and perhaps beyond it": names, "not determined by the record": free}
    return "; ".join(f"{what}: {', '.join(each)}" for what, each in groups.items() if each)


def _correlations(
    names: Sequence[str], covariance: NDArray, unknown: NDArray
) -> dict[tuple[str, str], float]:
    """Correlations of the determined parameters (k,) with all shared coordinates behind them."""
    scale = np.sqrt(np.diag(covariance))
    known = [
        i for i, each in enumerate(scale) if each > 0 and not (i < len(unknown) and unknown[i])
    ]
    made = {
        (names[i], names[j]): float(covariance[i, j] / scale[i] / scale[j])
        for i, j in combinations(known, 2)
        if i < len(unknown)
    }
    return dict(sorted(made.items(), key=lambda each: -abs(each[1])))


def _sizes(
    equations: CorrectedEquations, memory: Memory | None, estimation: Estimation, found: Point
) -> dict[str, float]:
    """The root mean square of each term over the calibration record, the largest first."""
    states = estimation.simulated(found)[1].reshape(-1, len(estimation.unknowns.start))
    own, more = len(equations.twin.states), 2 if memory else 0
    first = len(found.shared) - len(equations.coefficients) - more
    psi = found.shared[first : len(found.shared) - more]
    commands = estimation.acting(found).reshape(len(states), -1)
    values = equations.values(states[:, :own], commands, psi)
    sizes = np.abs(psi[equations.weights]) * np.sqrt(np.mean(values**2, axis=0))
    names = [equations.coefficients[place].name for place in equations.weights]
    if memory:
        names.append(f"{memory.state}: memory over {memory.fitted(found.shared):.3g} s")
        value = memory.values(equations, states[:, -1])
        sizes = np.append(sizes, np.abs(found.shared[-2]) * np.sqrt(np.mean(value**2)))
    return {names[i]: float(sizes[i]) for i in np.argsort(-sizes)}
