"""What all black-box models share: checks, estimation on free simulation, and the result.

A black-box model, but the LSTM, is a `StateTwin` whose equations know nothing of the system. So it
is estimated, simulated, saved and used as a twin with corrected dynamics is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.checks import given, require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import checked_stride
from retwin.update.corrected import CorrectedTwin
from retwin.update.dynamics.estimation import Estimation, Point, correlation_time
from retwin.update.dynamics.filter.noise import widening
from retwin.update.dynamics.fitting import assembled
from retwin.update.dynamics.left_out import held_out
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of
from retwin.update.forecast_errors import value_range

PATIENCE = 2
"""Orders, or strengths of a prior, that are tried beyond the best one."""


@dataclass(frozen=True, eq=False)
class BlackBox:
    """A fitted black-box model.

    Attributes
    ----------
    twin : DynamicsTwin or CorrectedTwin
        The model, as a distribution of outputs.
    figures : dict of str to float
        `order`, the number of past samples that the model has, or that its linear part has, which
        an LSTM has not;
        `parameters`, their number; `rms`, the error of free simulation over the calibration record,
        and `held_out`, that of blocks left out, in output units, or relative to each output's
        standard deviation where units differ.
    seconds : float
        Duration of `fit_black_box`.

    """

    twin: DynamicsTwin | CorrectedTwin
    figures: dict[str, float]
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class BlackBoxFit:
    """A model at its most probable parameters.

    Attributes
    ----------
    estimation : Estimation
        The equations, and the variance of the error of an effective sample.
    point : Point
        The optimum.
    errors : NDArray
        (n, T, d_y), of samples by models that were fitted without them; NaN of others.

    """

    estimation: Estimation
    point: Point
    errors: NDArray

    @property
    def held_out(self) -> float:
        """Root mean square of `errors`; infinite if a simulation diverges."""
        tested = self._tested
        error = tested.rms(np.where(tested.seen, self.errors, 0.0))
        return error if np.isfinite(error) else np.inf

    @property
    def _tested(self) -> Estimation:
        return replace(self.estimation, seen=~np.isnan(self.errors))

    def searched(self, variance: NDArray, *, max_steps: int = 25) -> BlackBoxFit:
        """The most probable point nearby with another variance of the errors.

        Parameters
        ----------
        max_steps : int, default 25
            Steps of the search with each variance at most.

        """
        estimation = replace(self.estimation, variance=variance)
        found = estimation.minimised(estimation.linearised(self.point), max_steps)
        return replace(self, estimation=estimation, point=found.point)

    def model(self, order: int, corrected: int) -> BlackBox:
        """The model as a distribution; the equations of so many first states have noise."""
        estimation, point = self.estimation, self.point
        steps = np.diff(estimation.simulated(point)[1], axis=1)
        speed = np.sqrt(np.mean(steps**2, axis=(0, 1)))
        speed, whole = np.where(speed > 0, speed, 1.0), [np.full(estimation.seen.shape[:2], True)]
        found = estimation.linearised(point)
        unmoved = np.zeros((1, estimation.unknowns.count))
        names = tuple(each.name for each in estimation.twin.states[:corrected])
        made = assembled(estimation, found, names, speed, whole, unmoved)
        uncertain = held_out(estimation, found, held_out_parts(estimation.seen))
        factors = widening(made, self._tested, replace(uncertain, errors=self.errors))
        made = replace(made, widening=factors)
        figures = {
            "order": float(order),
            "parameters": float(estimation.unknowns.count),
            "rms": estimation.rms(estimation.residual(point)),
            "held_out": self.held_out,
        }
        return BlackBox(made, figures)


def check_records(observed: Trajectories) -> None:
    """Refuse records from which no model of the outputs by the commands can be learned.

    Raises
    ------
    InputError
        No trajectory, one with a fault, no command channel, or an output that was never measured
        or that never changes.

    """
    checked_stride(observed, observed, None, "observed")  # type: ignore[arg-type]  # its channels
    low, high = value_range(np.where(observed.mask, observed.observed, np.nan))
    fixed = [name for name, same in zip(observed.outputs.names, low == high, strict=True) if same]
    driven = not fixed and len(observed.inputs) > 0
    expected = "commands, and outputs that are measured and that change"
    got = f"outputs that do not: {', '.join(fixed)}" if fixed else "no commands"
    remedy = "leave such outputs out, and record the commands"
    require(driven, "observed", expected=expected, got=got, remedy=remedy)


def best_order(
    orders: Sequence[int], fit: Callable[[int], BlackBoxFit | None], progress: Progress | None
) -> tuple[int, BlackBoxFit]:
    """The order with the least error of held-out blocks in free simulation, and its fit.

    Raises
    ------
    InputError
        No order can be fitted.

    """
    best: tuple[int, BlackBoxFit] | None = None
    for done, order in enumerate(orders, 1):
        found = fit(order)
        error = np.inf if found is None else found.held_out
        # Ratio of held-out errors below which a larger order is better.
        if found is not None and error < (0.99 * best[1].held_out if best else np.inf):
            best = order, found
        if progress is not None:
            progress(0.9 * done / len(orders))
        if best is not None and order - best[0] >= PATIENCE:
            break
    expected = "records by which a model of past samples can be simulated"
    got = "records with which every order diverges in free simulation, or in which too few samples "
    got += "follow each other"
    remedy = "give longer records, with all outputs measured at consecutive samples"
    return given("observed", best, expected, got=got, remedy=remedy)


def held_out_parts(seen: NDArray, *, folds: int = 10) -> list[NDArray]:
    """The parts (n, T) of a record that are held out in turn.

    Each trajectory is cut into blocks, of which a part has one, another one in each. The first
    block is in no part, since without it hardly anything determines the states at the start.

    Parameters
    ----------
    folds : int, default 10
        Parts of the calibration record, each made of blocks of all trajectories, that are held out.

    """
    trajectories, samples, _ = seen.shape
    block = np.arange(samples) * (folds + 1) // samples
    own = (block - 1 + np.arange(trajectories)[:, None]) % folds
    # Samples that are fitted again and again, without each part in turn; of longer records fewer
    # parts are held out.
    count = int(np.clip(100_000 // max(1, seen.sum()), 1, folds))
    return [(own == part) & (block > 0) for part in range(count)]


def cross_validated(
    seen: NDArray, fitted: Callable[[NDArray], BlackBoxFit | None]
) -> BlackBoxFit | None:
    """The fit to all samples, with the errors of parts by fits without them.

    Parameters
    ----------
    seen : NDArray
        (n, T, d_y) bool, the measured samples.
    fitted : callable
        From a part (n, T) that is left out to the fit without it; None where that diverges.

    """
    parts = held_out_parts(seen)
    found = [fitted(part) for part in (np.zeros(seen.shape[:2], dtype=bool), *parts)]
    good = [each for each in found if each is not None]
    if len(good) < len(found):
        return None
    return replace(good[0], errors=held_out_errors(good[1:], parts, seen))


def held_out_errors(
    fits: Sequence[BlackBoxFit], parts: Sequence[NDArray], seen: NDArray
) -> NDArray:
    """Errors (n, T, d_y) of each part by the fit without it, NaN of samples in no part."""
    errors = np.full(seen.shape, np.nan)
    for fit, part in zip(fits, parts, strict=True):
        place = part[..., None] & seen
        residual = replace(fit.estimation, seen=seen).residual(fit.point)
        errors[place] = np.where(np.isfinite(residual), residual, np.inf)[place]
    return errors


def estimation_of(twin: StateTwin, observed: Trajectories, part: NDArray) -> Estimation:
    """The estimation of all parameters and starts without a part (n, T), with unit variances."""
    base, free, values = state_twin_of(twin)
    unknowns, seen = unknowns_of(base, free, values), observed.mask & ~part[..., None]
    return Estimation(base, observed, unknowns, seen, np.ones(len(base.outputs)))


def states_within(starts: NDArray, bound: float) -> list[State]:
    """States (d_x,) without a unit, which begin at the mean of `starts` (records, d_x)."""
    means = enumerate(starts.mean(axis=0).tolist(), 1)
    return [State(f"x{i}", "1", mean, -bound, bound) for i, mean in means]


def with_best_prior(start: Callable[[NDArray], BlackBoxFit], seen: NDArray) -> BlackBoxFit | None:
    """The fit to all samples whose prior has the strength that predicts held-out parts best.

    The assumed error of the outputs begins large, which makes the prior strong, and falls from step
    to step, until parts are no longer predicted better by the fits without them.

    Parameters
    ----------
    start : callable
        From a part (n, T) that is left out to the model where it begins, with its prior.
    seen : NDArray
        (n, T, d_y) bool, the measured samples.

    Returns
    -------
    BlackBoxFit or None
        None where the simulation diverges at the start.

    """
    parts = held_out_parts(seen)
    whole, fits = start(np.zeros(seen.shape[:2], dtype=bool)), [start(part) for part in parts]
    if not all(each.estimation.linearised(each.point).finite for each in fits):
        return None
    # Variance of the error of an effective sample that is assumed first, over that of the model
    # where it begins: a prior so strong that nonlinear terms begin near 0.
    variance = 1000.0 * observed_variance(fits[0].estimation, fits[0].point)
    best, least, since = fits[0], np.inf, 0
    # Number of variances at most.
    for _ in range(8):
        fits = [each.searched(variance) for each in fits]
        found = replace(whole, errors=held_out_errors(fits, parts, seen))
        since += 1
        if found.held_out < least:
            whole, best, least, since = found, fits[0], found.held_out, 0
        if since == PATIENCE:
            break
        # Ratio of that variance to the next one.
        variance = variance / 10.0
    whole = replace(whole, point=best.point).searched(best.estimation.variance)
    observed = observed_variance(whole.estimation, whole.point)
    return replace(whole, estimation=replace(whole.estimation, variance=observed))


def observed_variance(estimation: Estimation, point: Point) -> NDArray:
    """The variance (d_y,) of the error of an effective sample at a point."""
    residual = estimation.residual(point)
    return estimation.power(residual) * correlation_time(residual)


def followed(estimation: Estimation, point: Point, *, max_passes: int = 6) -> BlackBoxFit | None:
    """The fit whose assumed errors are those that are observed; None where the start diverges.

    Parameters
    ----------
    max_passes : int, default 6
        Times that the error of the outputs is estimated anew.

    """
    if not np.isfinite(estimation.residual(point)).all():
        return None
    for _ in range(max_passes):
        variance = observed_variance(estimation, point)
        # Logarithm of the ratio of two variances below which they agree.
        settled = np.all(np.abs(np.log(variance / estimation.variance)) < 0.1)
        estimation = replace(estimation, variance=variance)
        if settled:
            break
        found = estimation.linearised(point)
        if not found.finite:
            return None
        point = estimation.minimised(found).point
    return BlackBoxFit(estimation, point, np.full(estimation.seen.shape, np.nan))
