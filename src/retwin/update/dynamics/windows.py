"""`Windows`: simulations in windows of a record, whose starts are those that fit best.

Over a whole record the errors of an integrating or unstable plant grow with time: those of its
start, of its disturbances and of rounding decide the fit. In windows they have no time to grow. The
states at the first sample of each window are estimated with the parameters (multiple shooting), and
eliminated, since they are those that fit best at any value of the parameters (variable projection).

References
----------
Bock, "Recent advances in parameter identification techniques for ODE", 1983. Kaufman, "A variable
projection method for solving separable nonlinear least squares problems", 1975: the derivative.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics.estimation import Estimation
from retwin.update.dynamics.linearised import Point
from retwin.update.dynamics.unknowns import Unknowns, state_twin_of, unknowns_of


@dataclass(frozen=True, eq=False)
class Windows:
    """Simulations of a twin in windows of measured trajectories.

    Attributes
    ----------
    twin : ParametricTwin
        That of a `StateTwin`.
    observed : Trajectories
        The n trajectories.
    rows, first : NDArray
        (w,), the trajectory of each window, and its first sample.
    length : int
        Samples of a window; those after the end of a trajectory are left out.
    used : NDArray
        (n, T, d_y) bool, the samples by which starts are estimated.
    unit : NDArray
        (d_y,), physical units per unit of a residual.
    unknown : NDArray
        (d_x,) bool, the states whose starts are estimated.

    """

    twin: ParametricTwin
    observed: Trajectories
    rows: NDArray
    first: NDArray
    length: int
    used: NDArray
    unit: NDArray
    unknown: NDArray

    @cached_property
    def _samples(self) -> tuple[NDArray, NDArray]:
        """Indices (w, L) of trajectories and samples; the last sample stands for those after it."""
        samples = self.first[:, None] + np.arange(self.length)
        last = self.observed.steps - 1
        return np.repeat(self.rows[:, None], self.length, 1), np.minimum(samples, last)

    @cached_property
    def inside(self) -> NDArray:
        """(n, T) bool, the samples that are in a window."""
        made = np.zeros(self.observed.mask.shape[:2], dtype=bool)
        made[self._samples] = True
        return made

    @cached_property
    def _estimation(self) -> Estimation:
        """The estimation of the starts at the present values."""
        rows, samples = self._samples
        own = self.used[rows, samples]
        own[self.first[:, None] + np.arange(self.length) >= self.observed.steps] = False
        cut = Trajectories(
            commands=self.observed.commands[rows, samples].astype(np.float64),
            nominal=np.zeros(own.shape),
            observed=self.observed.observed[rows, samples],
            mask=own,
            inputs=self.observed.inputs,
            outputs=self.observed.outputs,
            rate=self.observed.rate,
        )
        spread = (spread_of(cut) / self.unit).max(initial=0.0)
        # Error of a sample, over the standard deviation of its output, to a hundredth of which the
        # starts are found.
        variance = (1e-3 * (spread or 1.0) * self.unit) ** 2
        base = state_twin_of(self.twin)[0]
        return Estimation(base, cut, self._unknowns(self.twin), own, variance)

    def _unknowns(self, twin: ParametricTwin) -> Unknowns:
        """The starts as unknowns, at the parameters of a twin, without any prior."""
        base, _, values = state_twin_of(twin)
        free = np.flatnonzero(self.unknown)
        bounds = [
            (-np.inf, np.inf) if each.low is None else (each.low, each.high) for each in base.states
        ]
        low, high = np.array(bounds, dtype=float).T
        return replace(
            unknowns_of(base, (), values),
            low=low[free],
            high=high[free],
            free=free,
            start_deviation=np.full(len(free), np.inf),
        )

    @cached_property
    def _present(self) -> NDArray:
        """Starts (w, m) at the present values, at which every search of others begins."""
        own = self._estimation
        start = np.tile(own.unknowns.start[own.unknowns.free], (len(self.rows), 1))
        return self._search(own, start)

    @staticmethod
    def _search(own: Estimation, start: NDArray) -> NDArray:
        """The best starts (w, m) for an estimation; those given where a simulation fails."""
        found = own.linearised(Point(np.zeros(0), start))
        return own.minimised(found).point.starts if found.finite else start

    @lru_cache(maxsize=1)  # noqa: B019 - the search asks for residuals, then for derivatives there
    def _at(self, theta: tuple[float, ...]) -> tuple[NDArray, NDArray, NDArray]:
        """States (w, d_x) at the first samples, outputs (w, L, d_y), and their derivatives.

        These are by all parameters of `StateTwin`.
        """
        twin = self.twin.with_values(theta)
        own = replace(self._estimation, unknowns=self._unknowns(twin))
        point = own.theta(Point(np.zeros(0), self._search(own, self._present)))
        outputs, slopes = own.twin.steps().sensitivities(own.commands, point)
        return point[:, len(own.twin.parameters) :], outputs, slopes

    def starts(self, theta: NDArray) -> NDArray:
        """The states (w, d_x) at the first sample of each window, at parameters (k,)."""
        return self._at(tuple(theta.tolist()))[0]

    def own_starts(self, theta: NDArray) -> dict[int, NDArray]:
        """Of each parameter that is a start which is estimated, its value in each trajectory.

        `theta` (k,) are the others; parameters are given by their numbers.
        """
        names = [f"start_{each.name}" for each in self._estimation.twin.states]
        made, begin = {}, self.starts(theta)[self.first == 0]
        for i, each in enumerate(self.twin.parameters):
            own = [(names.index(place), e) for place, e in each.places.items() if place in names]
            if own and len(begin) and all(self.unknown[state] for state, _ in own):
                values = np.mean([begin[:, state] / factor for state, factor in own], axis=0)
                made[i] = np.clip(values, each.low, each.high)
        return made

    def outputs(self, theta: NDArray) -> NDArray:
        """Outputs (n, T, d_y) at parameters (k,): NaN where a simulation fails, 0 in no window."""
        return self._join(self._at(tuple(theta.tolist()))[1])

    def derivatives(self, theta: NDArray, *, dependent: float = 1e-10) -> NDArray:
        """Derivatives (n, T, d_y, k) of the outputs by the parameters, where the starts follow.

        Parameters
        ----------
        dependent : float, default 1e-10
            Singular value, over the largest one of a window, below which a combination of its
            starts has no effect.

        """
        slopes, own = self._at(tuple(theta.tolist()))[2], self._estimation
        parameters = len(own.twin.parameters)
        mixed = slopes[..., :parameters] @ self.twin.mixing[:parameters]
        by_start = slopes[..., parameters + np.flatnonzero(self.unknown)]
        if not (np.isfinite(mixed).all() and np.isfinite(by_start).all()):
            return self._join(np.full_like(mixed, np.nan))
        weight = own.seen[..., None] / self.unit[:, None]
        flat = [(weight * e).reshape(len(e), -1, e.shape[-1]) for e in (by_start, mixed)]
        follow = np.linalg.pinv(flat[0], dependent) @ flat[1]
        return self._join(mixed - by_start @ follow[:, None])

    def _join(self, windows: NDArray) -> NDArray:
        """Values (n, T, …) of those of the windows (w, L, …)."""
        made = np.zeros((*self.observed.mask.shape[:2], *windows.shape[2:]))
        within = self.first[:, None] + np.arange(self.length) < self.observed.steps
        rows, samples = self._samples
        made[rows[within], samples[within]] = windows[within]
        return np.where(np.isfinite(made), made, np.nan)


def windows_of(
    twin: ParametricTwin,
    observed: Trajectories,
    length: int | None,
    used: NDArray,
    *,
    warm: int = 0,
    own: bool = False,
) -> Windows | None:
    """Windows of a number of samples, or whole records, in which unstated starts are estimated.

    Parameters
    ----------
    twin, observed, used
        See `Windows`.
    length : int or None
        Samples of a window; None for whole records.
    warm : int, default 0
        Samples at the begin of each window by which alone its starts are estimated, so that the
        others are predictions; 0 for all. With it, windows that are not whole are left out, and the
        first one begins where the trajectory was first measured.
    own : bool, default False
        Whether each whole record has its own start also where that is a parameter of the twin.

    Returns
    -------
    Windows or None
        None for whole records whose starts are all given.

    """
    base, free, _ = state_twin_of(twin)
    parameters = {place for each in free for place in each.places}
    unknown = np.array([length is not None or s.start is None for s in base.states])
    if length is None:
        unknown &= [own or f"start_{s.name}" not in parameters for s in base.states]
        if not unknown.any():
            return None
    size = length or observed.steps
    seen = np.asarray(np.any(observed.mask, axis=2))
    rows, first = [], []
    for row in np.flatnonzero(seen.any(axis=1)):
        places = np.flatnonzero(seen[row])
        begin, end = int(places[0]) if warm else 0, int(places[-1]) + 1
        begins = np.arange(begin, end - size + 1 if warm else end, size)
        rows += [row] * len(begins)
        first += begins.tolist()
    made_rows, made_first = np.array(rows, dtype=int), np.array(first, dtype=int)
    if warm:
        used = used.copy()
        for row, begin in zip(rows, first, strict=True):
            used[row, begin + warm : begin + size] = False
    # A window without measurements has no start.
    kept = [used[r, f : f + size].any() for r, f in zip(rows, first, strict=True)]
    alike = len(set(observed.outputs.units)) == 1
    spread = spread_of(observed)
    unit = np.ones(len(spread)) if alike else np.maximum(spread, 1e-12)
    return Windows(twin, observed, made_rows[kept], made_first[kept], size, used, unit, unknown)


def spread_of(observed: Trajectories) -> NDArray:
    """Standard deviations (d_y,) of the measured outputs; 0 of one that was never measured."""
    seen = observed.mask
    count = np.maximum(seen.sum(axis=(0, 1)), 1)
    values = np.where(seen, observed.observed, 0.0).astype(np.float64)
    error = np.where(seen, values - values.sum(axis=(0, 1)) / count, 0.0)
    return np.asarray(np.sqrt(np.sum(error**2, axis=(0, 1)) / count))


def simulated(
    twin: ParametricTwin, measured: Trajectories, used: NDArray, *, seed: int, own: bool = False
) -> NDArray:
    """Outputs (n, T, d_y) of free simulations, whose unstated starts fit the samples `used`."""
    windows = windows_of(twin, measured, None, used, own=own) if state_based(twin) else None
    outputs = None if windows is None else windows.outputs(np.array(twin.values))
    if outputs is None or np.isnan(outputs).any():
        outputs = twin.simulate(measured.commands.astype(np.float64), seed=seed).observed
    return np.asarray(outputs)


def state_based(twin: object) -> bool:
    """Whether a twin is a `ParametricTwin` of a `StateTwin`, whose starts can be estimated."""
    return isinstance(twin, ParametricTwin) and isinstance(twin.twin, StateTwin)


def sampled(mask: NDArray, stride: int) -> NDArray:
    """The measured samples (n, T, d_y), of which only every `stride`-th counts."""
    made = np.zeros_like(mask)
    made[:, ::stride] = mask[:, ::stride]
    return made
