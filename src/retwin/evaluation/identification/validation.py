"""`validate_identification`: the error of a twin before and after identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import Trajectories
from retwin.evaluation.identification.parameters import (
    Basis,
    Direction,
    ParameterEstimate,
    uncertainty_of,
)
from retwin.evaluation.identification.residual_tests import ResidualTest, residual_tests
from retwin.scores.intervals import MIN_GROUPS, jackknife_interval
from retwin.scores.residuals import decorrelated_after
from retwin.twins.twin import checked_stride
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.sensor_limits import limit_outputs
from retwin.update.dynamics.windows import simulated as simulated_outputs
from retwin.update.forecasts import BEGIN
from retwin.update.identification.horizon import predictions
from retwin.update.identification.identify import Updated
from retwin.update.identification.posterior import Posterior

Part = Literal["identification", "validation"]
Split = Literal["trajectories", "time", "none"]


@dataclass(frozen=True)
class RMSError:
    """Root mean square error of simulation before and after, in the output's unit.

    Attributes
    ----------
    before, after : float
        NaN where nothing was measured.
    ratio : float
        After over before.
    interval : (float, float) or None
        95 % interval of the ratio, by the jackknife over trajectories or blocks of time; None
        where there are fewer than five.
    groups : int
        Trajectories or blocks.
    samples : int
        Measurements.

    """

    before: float
    after: float
    ratio: float
    interval: tuple[float, float] | None
    groups: int
    samples: int


@dataclass(frozen=True)
class OutputError:
    """The errors of one output.

    Attributes
    ----------
    name, unit : str
        The output.
    spread : float
        Standard deviation of all its measurements.
    identification : RMSError
        On the measurements that the parameters were identified on.
    validation : RMSError or None
        On those that were held out; None if none were.
    mean : float
        The RMS error of the mean of the measurements used, on those that were held out if any were.

    """

    name: str
    unit: str
    spread: float
    identification: RMSError
    validation: RMSError | None
    mean: float = float("nan")


@dataclass(frozen=True, eq=False)
class Identification:
    """Identified parameters, and how far they can be trusted.

    Attributes
    ----------
    twin : ParametricTwin
        The twin with the identified values; of a posterior with its mean.
    parameters : tuple of ParameterEstimate
        The parameters before and after, with their uncertainty.
    correlation : NDArray
        (k, k), of the estimates; NaN where it is not defined.
    directions : tuple of Direction
        Combinations of parameters, from the best to the least determined.
    basis : str
        What the errors rest on: "trajectories", "samples" or "posterior".
    outputs : tuple of OutputError
        The errors of simulation before and after: free, or over `horizon`.
    residuals : tuple of ResidualTest
        Tests of the residuals after identification, on the held-out measurements if there are any.
    split : str
        What was held out: "trajectories", the last part of each in "time", or "none".
    simulated : dict of str to tuple
        By part, "identification" and "validation": measured trajectories, and outputs (n, T, d_y)
        of the twin before and after, within the limits of sensors that the records show. Over a
        horizon, the mask contains the samples predicted.
    found : Updated or Posterior
        The result of `rt.identify`.

    """

    twin: ParametricTwin
    parameters: tuple[ParameterEstimate, ...]
    correlation: NDArray
    directions: tuple[Direction, ...]
    basis: Basis
    outputs: tuple[OutputError, ...]
    residuals: tuple[ResidualTest, ...]
    split: Split
    simulated: dict[Part, tuple[Trajectories, NDArray, NDArray]]
    found: Updated | Posterior

    @property
    def compared(self) -> Part:
        """The part on which before and after are compared: held-out measurements if there are."""
        return "validation" if "validation" in self.simulated else "identification"

    def errors(self, part: Part) -> dict[str, RMSError]:
        """The errors of the outputs that were measured in a part, by name."""
        found = {each.name: getattr(each, part) for each in self.outputs}
        return {name: each for name, each in found.items() if each is not None and each.samples}

    @property
    def open_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are not identified, those at a bound among them."""
        return tuple(each.name for each in self.parameters if not each.identified)

    @property
    def begin_errors(self) -> dict[str, float]:
        """By output, the RMS error in the first tenth of each trajectory over that of the rest.

        It is that of the twin after identification, on the measurements that were used; outputs
        without errors in both parts are left out.
        """
        measured, _, after = self.simulated["identification"]
        first = np.arange(measured.steps) < np.maximum(1, measured.lengths[:, None] // BEGIN)
        error, made = measured.observed - after, {}
        for i, name in enumerate(measured.outputs.names):
            parts = [error[..., i][measured.mask[..., i] & part] for part in (first, ~first)]
            if all(map(len, parts)) and np.any(parts[1]):
                made[name] = float(np.sqrt(np.mean(parts[0] ** 2) / np.mean(parts[1] ** 2)))
        return made

    @property
    def horizon(self) -> float:
        """Time in s over which outputs are predicted; infinite in free simulation."""
        return self.found.horizon if isinstance(self.found, Updated) else float("inf")

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Names of the parameters that lie on a bound."""
        return tuple(each.name for each in self.parameters if each.at_bound)


def validate_identification(
    found: Updated | Posterior,
    before: ParametricTwin,
    used: Trajectories,
    held_out: Trajectories | None = None,
    *,
    seed: int = 0,
) -> Identification:
    """Compare free simulations of a twin before and after identification with measurements.

    Parameters
    ----------
    found : Updated or Posterior
        The result of `rt.identify`.
    before : ParametricTwin
        The twin that was given to it.
    used : Trajectories
        The measurements that were given to it.
    held_out : Trajectories, optional
        Measurements that it did not use, see `hold_out`.
    seed : int
        Seed of the simulations.

    Returns
    -------
    Identification
        The parameters with their uncertainty, errors before and after, and tests of the residuals.

    Raises
    ------
    InputError
        Measurements that do not fit the twin.
    SimulationError
        The twin cannot simulate some of the held-out commands.

    """
    identified = isinstance(found, Updated | Posterior)
    expected = "an Updated or a Posterior"
    remedy = "give what rt.identify returned"
    require(identified, "found", expected=expected, got=type(found).__name__, remedy=remedy)
    mean = found.twin.twin if isinstance(found, Posterior) else found.twin
    expected = f"the twin with the parameters {', '.join(mean.names)}"
    got = ", ".join(before.names)
    remedy = "give the twin that was identified, at its values before"
    require(mean.names == before.names, "before", expected=expected, got=got, remedy=remedy)
    horizon = found.horizon if isinstance(found, Updated) else float("inf")
    parts: dict[Part, Trajectories] = {"identification": used}
    if held_out is not None:
        parts["validation"] = held_out
    simulated: dict[Part, tuple[Trajectories, NDArray, NDArray]] = {}
    limits = limits_of(used)
    twins = limit_outputs(before, limits), limit_outputs(mean, limits)
    for part, measured in parts.items():
        checked_stride(before, measured, None, part)
        own = isinstance(found, Updated) and bool(found.own_starts)
        simulated[part] = _simulate(twins, measured, used, horizon, seed=seed, own=own)
    last = simulated["validation" if held_out is not None else "identification"]
    return Identification(
        twin=mean,
        **vars(uncertainty_of(before, found)),
        outputs=_outputs(simulated, used),
        residuals=residual_tests(_residual(last[0], last[2]), last[0]),
        split=_split(used, held_out),
        simulated=simulated,
        found=found,
    )


def _simulate(
    twins: tuple[ParametricTwin, ParametricTwin],
    measured: Trajectories,
    used: Trajectories,
    horizon: float,
    *,
    seed: int,
    own: bool,
) -> tuple[Trajectories, NDArray, NDArray]:
    """Measurements, and outputs before and after: free, or predicted over a horizon in s.

    Starts that are not given are those that fit the measurements used of the same trajectories,
    or the first tenth of those that were held out as a whole.
    """
    if np.isfinite(horizon):
        made = [predictions(twin, measured, round(horizon * measured.rate)) for twin in twins]
        outputs = [measured.observed - error for error, _ in made]
        return measured.replace(mask=made[0][1]), outputs[0], outputs[1]
    known = used.mask
    if _split(used, measured) == "trajectories":
        begin = np.arange(measured.steps) < np.maximum(measured.lengths[:, None] // BEGIN, 2)
        known = measured.mask & begin[..., None]
    before, after = (simulated_outputs(twin, measured, known, seed=seed, own=own) for twin in twins)
    return measured, before, after


def _split(used: Trajectories, held_out: Trajectories | None) -> Split:
    """How the measurements were divided."""
    if held_out is None:
        return "none"
    same = used.commands.shape == held_out.commands.shape and np.array_equal(used.ids, held_out.ids)
    if same and np.array_equal(used.commands, held_out.commands):
        return "time"
    return "trajectories"


def _residual(measured: Trajectories, outputs: NDArray) -> NDArray:
    """Measured minus simulated outputs (n, T, d_y), NaN where nothing was measured."""
    return np.where(measured.mask, measured.observed.astype(np.float64) - outputs, np.nan)


def _outputs(
    simulated: dict[Part, tuple[Trajectories, NDArray, NDArray]], used: Trajectories
) -> tuple[OutputError, ...]:
    """The errors of each output in each part."""
    first = simulated["identification"][0]
    made = []
    for channel, (name, unit) in enumerate(zip(first.outputs.names, first.outputs.units)):  # noqa: B905
        values = [
            each.observed[..., channel][each.mask[..., channel]]
            for each, _, _ in simulated.values()
        ]
        together = np.concatenate(values)
        errors: dict[Part, RMSError] = {
            part: _rms(*(_residual(measured, each)[..., channel] for each in (before, after)))
            for part, (measured, before, after) in simulated.items()
        }
        spread = float(together.std()) if len(together) else float("nan")
        known, last = used.observed[..., channel][used.mask[..., channel]], values[-1]
        mean = float("nan")
        if len(known) and len(last):
            mean = float(np.sqrt(np.mean((last.astype(np.float64) - known.mean()) ** 2)))
        made.append(
            OutputError(
                name, unit, spread, errors["identification"], errors.get("validation"), mean
            )
        )
    return tuple(made)


def _rms(before: NDArray, after: NDArray) -> RMSError:
    """Errors of one output, from residuals (n, T), and the interval of their ratio."""
    seen = np.isfinite(after)
    if not seen.any():
        nothing = float("nan")
        return RMSError(nothing, nothing, nothing, None, 0, 0)
    first, second = (float(np.sqrt(np.mean(each[seen] ** 2))) for each in (before, after))
    groups = _groups(after)
    count = int(groups.max()) + 1
    sums = [np.bincount(groups[seen], each[seen] ** 2, count) for each in (before, after)]
    filled = np.bincount(groups[seen], minlength=count) > 0

    def ratio(weights: NDArray) -> NDArray:
        return np.sqrt((weights @ sums[1][filled]) / (weights @ sums[0][filled]))

    number = int(filled.sum())
    interval = None
    if number >= MIN_GROUPS and (sums[0] > 0).all():
        interval = jackknife_interval(ratio, number, positive=True)
    change = second / first if first > 0 else float("nan")
    return RMSError(first, second, change, interval, number, int(seen.sum()))


def _groups(residual: NDArray, *, max_blocks: int = 20) -> NDArray:
    """A group for each sample (n, T): its trajectory, or a block of time of it.

    Where there are fewer than five trajectories, their measured parts are divided into blocks that
    are longer than the residuals correlate, so that blocks are nearly independent.

    Parameters
    ----------
    max_blocks : int, default 20
        Blocks into which held-out records are divided for an interval, at most.

    """
    seen = np.isfinite(residual)
    rows = np.broadcast_to(np.arange(len(residual))[:, None], residual.shape)
    if len(residual) >= MIN_GROUPS:
        return rows
    place = np.cumsum(seen, axis=1) - 1
    length = max(decorrelated_after(residual), int(seen.sum()) // max_blocks, 1)
    blocks = np.maximum(seen.sum(axis=1) // length, 1)
    starts = np.concatenate([[0], np.cumsum(blocks)[:-1]])
    within = np.minimum(np.maximum(place, 0) // length, blocks[:, None] - 1)
    return starts[:, None] + within
