"""`choose_length`: whole records or windows, by the errors of predictions of samples left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics.windows import sampled, spread_of, state_based, windows_of

FOLDS = 4
"""Parts of the record that are left out in turn."""
LONGEST, RATIO = 10, 3
"""The longest window is the record by the first number; each other one is the one before by the
second. So a part that is left out contains two of the longest."""
SHORTEST = 20
"""Samples of the shortest window."""
LASTING = 0.5
"""Effect of a start or an early command on the outputs at the end of a record, over its largest
effect, from which a plant counts as integrating or unstable. That of a stable plant decays."""

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


def lasting(twin: ParametricTwin, observed: Trajectories) -> bool:
    """Whether the effect of a start, or of early commands, lasts until the end of a record.

    It does in an integrating, an unstable or a very slow plant; so do the effects of disturbances.
    The record is the longest one. Where the states of a twin cannot be set, commands are held for a
    while; not the first one, on which the start may depend.
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
    return bool((at_end > LASTING * size.max(axis=0)).any())


def lengths_of(observed: Trajectories) -> list[int]:
    """The lengths of windows that are tried, in samples, the longest first."""
    length, made = int(observed.lengths.max()) // LONGEST, []
    while length >= SHORTEST:
        made.append(length)
        length //= RATIO
    return made


def choose_length(observed: Trajectories, fit: Fit, stride: int, *, whole: bool) -> list[Candidate]:
    """The candidates, the chosen one first.

    Each is fitted without a part of the record in turn, and predicts windows of that part from
    their first halves, and the part as a whole from the samples before it. It is chosen whose
    errors are the smallest in the geometric mean over the same horizons for all; whole records are
    preferred to windows within one standard error.
    Horizons over which nothing predicts better than the mean of the record do not count: there
    the disturbances decide, and under feedback the commands reveal these.

    Parameters
    ----------
    observed : Trajectories
        The record.
    fit : callable
        See `Fit`.
    stride : int
        Every how many samples the sensor measures.
    whole : bool
        Whether whole records are a candidate.

    """
    horizons = lengths_of(observed)
    lengths: list[int | None] = [*([None] if whole else []), *horizons]
    if len(lengths) < 2 or not horizons:
        return [Candidate(each, 1.0, 0.0) for each in lengths[:1]]
    spread = spread_of(observed)
    spread = np.where(spread > 0, spread, 1.0)
    spread[~observed.mask.any(axis=(0, 1))] = np.nan
    logs = np.full((len(lengths), FOLDS, 1 + len(horizons)), np.nan)
    scale, warm = (stride, spread), horizons[0]
    for k, part in enumerate(_parts(observed)):
        rest = observed.replace(mask=observed.mask & ~part[..., None])
        left = observed.replace(mask=observed.mask & part[..., None])
        before = part | np.pad(part[:, warm:], ((0, 0), (0, warm)))
        longer = observed.replace(mask=observed.mask & before[..., None])
        seen = longer.mask.any(axis=2).sum(axis=1)
        longest = int(seen[seen > 0].min(initial=observed.steps)) - warm
        for i, length in enumerate(lengths):
            try:
                twin = fit(rest, length)
            except InputError:  # a simulation of the whole record fails
                continue
            logs[i, k] = [
                _error(twin, longer, longest, scale, warm=warm),
                *(_error(twin, left, each, scale) for each in horizons),
            ]
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
    first = made[0]
    if first.length is None and np.log(first.error) <= first.deviation:
        order.sort(key=lambda i: i != 0)
    return [made[i] for i in order]


def _parts(observed: Trajectories) -> Iterator[NDArray]:
    """Parts (n, T) of the samples: trajectories where there are enough, else blocks of time."""
    shape = observed.mask.shape[:2]
    if len(observed) >= FOLDS:
        place = np.broadcast_to(np.arange(len(observed))[:, None] % FOLDS, shape)
    else:
        # By the last sample that was measured: what follows may be held out.
        seen = np.any(observed.mask, axis=2)
        length = observed.steps - np.argmax(seen[:, ::-1], axis=1)[:, None]
        place = np.minimum(np.arange(shape[1])[None] * FOLDS // length, FOLDS - 1)
    for k in range(FOLDS):
        yield place == k


def _error(
    twin: ParametricTwin,
    left: Trajectories,
    horizon: int,
    scale: tuple[int, NDArray],
    *,
    warm: int | None = None,
) -> float:
    """Logarithm of the RMS error over a horizon, in standard deviations of the outputs.

    These are NaN of outputs that were never measured, which do not count. The error is NaN where
    another one is not measured.
    """
    stride, spread = scale
    known = np.isfinite(spread)
    error, seen = predictions(twin, left, horizon, stride, warm=warm)
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
