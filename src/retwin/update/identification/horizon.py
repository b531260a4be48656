"""`choose_length`: whole records or windows, by the errors of predictions of samples left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics.windows import sampled, spread_of, state_based, windows_of

LONGEST, RATIO = 10, 3
"""The longest window is the record by the first number; each other one is the one before by the
second. So a part that is left out contains two of the longest."""

Fit = Callable[[Trajectories, int | None], ParametricTwin]
"""Fits a twin to measurements, in windows of so many samples or None for whole records."""


@dataclass(frozen=True)
class Candidate:
    """Windows of a length, and how well the parameters that fit in them predict.

    Attributes
    ----------
    length : int or None
        Samples of a window; None for whole records.
    error : float
        RMS error of the parts left out, over that of the best candidate: the geometric mean over
        horizons.
    deviation : float
        Standard error of the logarithm of `error`, from its differences between parts.

    """

    length: int | None
    error: float
    deviation: float


def lasting(twin: ParametricTwin, observed: Trajectories, *, lasting: float = 0.5) -> bool:
    """Whether the effect of a start, or of early commands, lasts until the end of a record.

    It does in an integrating, an unstable or a very slow plant; so do the effects of disturbances.
    The record is the longest one. Where the states of a twin cannot be set, commands are held for a
    while; not the first one, on which the start may depend.

    Parameters
    ----------
    lasting : float, default 0.5
        Effect of a start or an early command on the outputs at the end of a record, over its
        largest effect, from which a plant counts as integrating or unstable. That of a stable plant
        decays.

    """
    row = int(np.argmax(observed.lengths))
    last = int(observed.lengths[row])
    commands = observed.commands[row : row + 1, :last].astype(np.float64)
    if state_based(twin):
        values = twin.inner(dict(zip(twin.names, twin.values, strict=True)))
        _, slopes = twin.twin.sensitivities(commands, values)  # type: ignore[attr-defined]
        effect = slopes[0, ..., -len(twin.twin.states) :]  # type: ignore[attr-defined]
    else:
        changed, tenth = commands.copy(), last // LONGEST
        changed[:, tenth // 2 : tenth] = changed[:, tenth // 2 - 1 : tenth // 2]
        try:
            made = twin.simulate(np.concatenate([commands, commands, changed]), seed=0).observed
        except SimulationError:
            return False
        if (made[1] != made[0]).any():  # of a random twin, differences show no effect
            return False
        effect = (made[2] - made[0])[..., None].astype(np.float64)
    if not np.isfinite(effect).all():
        return True
    size = np.abs(effect).max(axis=1)
    at_end = size[-max(1, last // LONGEST) :].max(axis=0)
    return bool((at_end > lasting * size.max(axis=0)).any())


def lengths_of(observed: Trajectories, *, shortest: int = 20) -> list[int]:
    """The lengths of windows that are tried, in samples, the longest first.

    Parameters
    ----------
    shortest : int, default 20
        Samples of the shortest window.

    """
    length, made = int(observed.lengths.max()) // LONGEST, []
    while length >= shortest:
        made.append(length)
        length //= RATIO
    return made


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Parts of a record that are left out in turn, and errors of predictions of them.

    Attributes
    ----------
    observed : Trajectories
        The record.
    fit : callable
        See `Fit`.
    stride : int
        Every how many samples the sensor measures.

    """

    observed: Trajectories
    fit: Fit
    stride: int

    @cached_property
    def parts(self) -> list[NDArray]:
        """(n, T) each."""
        return list(_parts(self.observed))

    @cached_property
    def spread(self) -> NDArray:
        """Standard deviations (d_y,) of the outputs; NaN of those that were never measured."""
        spread = spread_of(self.observed)
        spread = np.where(spread > 0, spread, 1.0)
        spread[~self.observed.mask.any(axis=(0, 1))] = np.nan
        return spread

    def fit_without(self, length: int | None) -> list[ParametricTwin | None]:
        """The twins without each part, from windows of a length; None where a simulation fails."""
        made: list[ParametricTwin | None] = []
        for part in self.parts:
            rest = self.observed.replace(mask=self.observed.mask & ~part[..., None])
            try:
                made.append(self.fit(rest, length))
            except InputError:
                made.append(None)
        return made

    def errors(self, twins: Sequence[ParametricTwin | None], horizons: Sequence[int]) -> NDArray:
        """Logarithms (K, 1 + h) of errors of each part as a whole, and over some horizons.

        A part is predicted as a whole from the samples before it, over a horizon from the first
        halves of windows.
        """
        observed, scale = self.observed, (self.stride, self.spread)
        warm, logs = lengths_of(observed)[0], np.full((len(twins), 1 + len(horizons)), np.nan)
        for k, (part, twin) in enumerate(zip(self.parts, twins, strict=True)):
            if twin is None:
                continue
            left = observed.replace(mask=observed.mask & part[..., None])
            before = part | np.pad(part[:, warm:], ((0, 0), (0, warm)))
            longer = observed.replace(mask=observed.mask & before[..., None])
            seen = longer.mask.any(axis=2).sum(axis=1)
            longest = int(seen[seen > 0].min(initial=observed.steps)) - warm
            logs[k] = [
                _error(twin, longer, longest, scale, warm=warm),
                *(_error(twin, left, each, scale) for each in horizons),
            ]
        return logs


def overfitted(held: HeldOut, residual: NDArray, without: Sequence[ParametricTwin | None]) -> bool:
    """Whether parameters fitted to whole records predict far worse what they have not seen.

    Compared are the errors of twins fitted `without` each part, which predict it from the samples
    before it, with the `residual` (n, P, d_y) of the fit to all. Then parameters and starts
    describe disturbances and what the twin lacks, which windows leave to their starts.
    """
    seen = held.observed.mask[:, :: held.stride]
    fitted = np.array(
        [
            _log_rms(residual, seen & part[:, :: held.stride, None], held.spread)
            for part in held.parts
        ]
    )
    alone, inside = np.exp(2 * held.errors(without, ())[:, 0]), np.exp(2 * fitted)
    known = np.isfinite(alone) & np.isfinite(inside)
    # Ratio of the errors of parts of a record that were left out to those of the fit, from which on
    # the parameters of whole records count as overfitted.
    return bool(alone[known].sum() > 2.0**2 * inside[known].sum())


def choose_length(held: HeldOut, whole: Sequence[ParametricTwin | None] | None) -> list[Candidate]:
    """The candidates, the chosen one first.

    Each is fitted without a part of the record in turn, and predicts that part. It is chosen whose
    errors are the smallest in the geometric mean over the same horizons for all.
    Horizons over which nothing predicts better than the mean of the record do not count: there
    the disturbances decide, and under feedback the commands reveal these.

    Parameters
    ----------
    held : HeldOut
        The parts.
    whole : sequence of ParametricTwin or None, optional
        The twins that were fitted to whole records without each part, where these are a candidate.

    """
    horizons = lengths_of(held.observed)
    lengths: list[int | None] = [*([] if whole is None else [None]), *horizons]
    if len(lengths) < 2:
        return [Candidate(each, 1.0, 0.0) for each in lengths]
    fits = [*([] if whole is None else [whole]), *map(held.fit_without, horizons)]
    logs = np.stack([held.errors(each, horizons) for each in fits])
    best = np.where(np.isfinite(logs), logs, np.inf).min(axis=0)
    known = np.isfinite(best)
    useful = np.where(known, best, 0.0).sum(axis=0) < 0
    return _rank(lengths, logs[..., useful] if useful.any() else logs[..., -1:])


def _rank(lengths: Sequence[int | None], logs: NDArray) -> list[Candidate]:
    """Candidates with logarithms of errors (c, K, h), the chosen one first."""
    known = np.isfinite(logs).any(axis=0)
    each = np.where(np.isnan(logs), np.inf, logs)[:, known]
    own = np.broadcast_to(np.arange(known.shape[0])[:, None], known.shape)[known]
    folds = np.stack([each[:, own == k].mean(axis=1) for k in np.unique(own)], axis=1)
    best = int(np.argmin(folds.mean(axis=1)))
    made = []
    for i, length in enumerate(lengths):
        difference = folds[i] - folds[best]
        finite = np.isfinite(difference).all()
        error = float(np.exp(difference.mean())) if finite else np.inf
        spread = float(difference.std(ddof=1)) if finite and len(difference) > 1 else 0.0
        made.append(Candidate(length, error, spread / np.sqrt(len(difference))))
    order = sorted(range(len(made)), key=lambda i: made[i].error)
    return [made[i] for i in order]


def _parts(observed: Trajectories, *, folds: int = 4) -> Iterator[NDArray]:
    """Parts (n, T) of the samples: trajectories where there are enough, else blocks of time.

    Parameters
    ----------
    folds : int, default 4
        Parts of the record that are left out in turn.

    """
    shape = observed.mask.shape[:2]
    if len(observed) >= folds:
        place = np.broadcast_to(np.arange(len(observed))[:, None] % folds, shape)
    else:
        # By the last sample that was measured: what follows may be held out.
        seen = np.any(observed.mask, axis=2)
        length = observed.steps - np.argmax(seen[:, ::-1], axis=1)[:, None]
        place = np.minimum(np.arange(shape[1])[None] * folds // length, folds - 1)
    for k in range(folds):
        yield place == k


def _error(
    twin: ParametricTwin,
    left: Trajectories,
    horizon: int,
    scale: tuple[int, NDArray],
    *,
    warm: int | None = None,
) -> float:
    """The logarithm of the RMS error of predictions over a horizon; see `_log_rms`."""
    stride, spread = scale
    return _log_rms(*predictions(twin, left, horizon, stride, warm=warm), spread)


def _log_rms(error: NDArray, seen: NDArray, spread: NDArray) -> float:
    """Logarithm of the RMS error of samples that are seen, in standard deviations of the outputs.

    These are NaN of outputs that were never measured, which do not count. The error is NaN where
    another one is not measured.
    """
    known = np.isfinite(spread)
    count = seen.sum(axis=(0, 1))
    if not count[known].all():
        return float("nan")
    power = np.sum(np.where(seen, error, 0.0) ** 2, axis=(0, 1))[known] / count[known]
    power = np.where(np.isfinite(power), power, np.inf) / spread[known] ** 2
    return float(np.mean(np.log(np.maximum(power, 1e-300)))) / 2


def predictions(
    twin: ParametricTwin,
    measured: Trajectories,
    horizon: int,
    stride: int = 1,
    *,
    warm: int | None = None,
) -> tuple[NDArray, NDArray]:
    """Errors of predictions over a horizon, from samples before it.

    Parameters
    ----------
    twin : ParametricTwin
        That of a `StateTwin`.
    measured : Trajectories
        The measurements.
    horizon : int
        Samples that are predicted from the starts that samples before gave.
    stride : int
        Every how many samples the sensor measures.
    warm : int, optional
        The samples before; by default as many as are predicted.

    Returns
    -------
    error : NDArray
        (n, T, d_y), measured minus predicted outputs.
    predicted : NDArray
        (n, T, d_y) bool, the measured samples that were predicted.

    """
    used = sampled(measured.mask, stride)
    warm = horizon if warm is None else warm
    windows = windows_of(twin, measured, warm + horizon, used, warm=warm)
    assert windows is not None
    if not len(windows.rows):
        return np.zeros(used.shape), np.zeros(used.shape, dtype=bool)
    outputs = windows.outputs(np.array(twin.values))
    return measured.observed - outputs, used & ~windows.used & windows.inside[..., None]
