"""`Misfit`: measured minus simulated outputs for many values of the parameters at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessPool

from retwin.data.trajectories import HEALTHY, UNLABELLED, Trajectories
from retwin.errors import InputError
from retwin.processes import sendable_errors, worker_pool
from retwin.twins.parametric import ParametricTwin
from retwin.twins.twin import SimulationError, checked_seed

__all__ = ["Misfit", "check_counts", "misfit_of"]


class Misfit:
    """How far a twin is off measured trajectories, at the samples that the sensor took.

    Residuals are in units of `unit`: 1 where all outputs share a physical unit, so that the norm is
    that of Eq. 2; else the standard deviation of each output at the twin's present values.

    Attributes
    ----------
    twin: the twin, at its present values.
    observed: measured, healthy.
    stride: every how many samples to look.
    seen: (n, P, d_y) bool, what was measured.
    unit: (d_y,), physical units per unit of a residual.
    spread: standard deviation of the twin's outputs, over `unit`: what is a large residual.
    low, high: bounds of the parameters, (k,).
    twin_runs: trajectories simulated so far.

    """

    def __init__(
        self,
        twin: ParametricTwin,
        observed: Trajectories,
        *,
        stride: int,
        seed: int,
        pool: ProcessPool | None = None,
        processes: int = 1,
    ) -> None:
        self.twin = twin
        self.observed = observed
        self.stride = stride
        self.seed = seed
        self.low, self.high = twin.bounds
        self.seen = observed.mask[:, ::stride]
        self.twin_runs = 0
        self._pool = pool
        self._processes = processes
        self._commands = observed.commands.astype(np.float64)
        self._measured = observed.observed[:, ::stride].astype(np.float64)
        self.present = self.outputs(np.array([twin.values]))[0]
        if np.isnan(self.present).any():
            raise InputError(
                "twin",
                expected="one that can simulate the commands at its present values",
                got="a simulation that failed",
                remedy="choose other starts of the parameters",
            )
        each = self.present.std(axis=(0, 1))
        alike = len(set(observed.outputs.units)) == 1
        self.unit = np.ones(len(each)) if alike else np.maximum(each, 1e-12)
        self.spread = float(np.sqrt(np.mean((each / self.unit) ** 2)))

    @property
    def interval(self) -> float:
        """Seconds between the samples that are looked at."""
        return self.stride / self.observed.rate

    @property
    def rms(self) -> float:
        """Root mean square of the residuals at the present values."""
        return self.rms_of(self.residuals_of(self.present[None]))

    def outputs(self, theta: NDArray) -> NDArray:
        """Simulated outputs (m, n, P, d_y) at parameters (m, k); NaN where a simulation failed."""
        self.twin_runs += len(theta) * len(self._commands)
        work = (self.twin, self._commands, self.stride, self.seed)
        if self._pool is None or len(theta) < 2:
            return _outputs(*work, theta)
        parts = np.array_split(theta, min(self._processes, len(theta)))
        futures = [self._pool.schedule(_in_worker, args=(*work, part)) for part in parts]
        return np.concatenate([future.result() for future in futures])

    def residuals(self, theta: NDArray) -> NDArray:
        """Residuals (m, n, P, d_y) at parameters (m, k); 0 where nothing was measured."""
        return self.residuals_of(self.outputs(theta))

    def residuals_of(self, outputs: NDArray) -> NDArray:
        """Residuals (m, n, P, d_y) of outputs that were simulated."""
        return np.where(self.seen, (self._measured - outputs) / self.unit, 0.0)

    def rms_of(self, residual: NDArray) -> float:
        """Root mean square over what was measured."""
        return float(np.sqrt(np.sum(residual**2) / self.seen.sum()))


@contextmanager
def misfit_of(
    twin: ParametricTwin,
    observed: Trajectories,
    *,
    seed: int,
    rate: float | None,
    processes: int,
) -> Iterator[Misfit]:
    """The misfit, with worker processes for as long as the block lasts if more than one is asked.

    Raises InputError for what cannot be compared.
    """
    checked_seed(seed)
    check_counts(processes=processes)
    stride = _checked(twin, observed, rate)
    if processes == 1:
        yield Misfit(twin, observed, stride=stride, seed=seed)
        return
    with worker_pool(processes) as pool:
        yield Misfit(twin, observed, stride=stride, seed=seed, pool=pool, processes=processes)


def _outputs(
    twin: ParametricTwin, commands: NDArray, stride: int, seed: int, theta: NDArray
) -> NDArray:
    each = len(commands)
    values = {name: np.repeat(theta[:, i], each) for i, name in enumerate(twin.names)}
    repeated = np.tile(commands, (len(theta), 1, 1))
    try:
        observed = twin.simulate(repeated, seed=seed, parameters=values).observed
    except SimulationError as error:
        # Some parameters are beyond what can be simulated: that is for the search to find out.
        observed = np.full((*repeated.shape[:2], len(twin.outputs)), np.nan)
        observed[error.finished.ids.astype(int)] = error.finished.observed
    made = observed[:, ::stride].astype(np.float64)
    return made.reshape(len(theta), each, *made.shape[1:])


def _in_worker(
    twin: ParametricTwin, commands: NDArray, stride: int, seed: int, theta: NDArray
) -> NDArray:
    with sendable_errors():
        return _outputs(twin, commands, stride, seed, theta)


def _checked(twin: ParametricTwin, observed: Trajectories, rate: float | None) -> int:
    """Every how many samples to look; InputError for what cannot be compared."""
    if not isinstance(twin, ParametricTwin):
        raise InputError(
            "twin",
            expected="a ParametricTwin, which declares what is free",
            got=type(twin).__name__,
            remedy="see ParametricTwin, CommandSide and ParametricTwin.built",
        )
    healthy = np.isin(observed.labels, (HEALTHY, UNLABELLED))
    if len(observed) == 0 or not healthy.all():
        raise InputError(
            "observed",
            expected="healthy trajectories, one at least",
            got=f"{len(observed)}, {int((~healthy).sum())} of them with a fault",
            remedy=f"take observed.with_label({HEALTHY!r})",
        )
    for name in ("inputs", "outputs", "rate"):
        ours, theirs = getattr(twin, name), getattr(observed, name)
        if ours != theirs:
            raise InputError(
                f"observed.{name}",
                expected=f"what the twin has, {ours}",
                got=f"{theirs}",
                remedy="load the file with its case, or convert it",
            )
    stride = 1 if rate is None else round(observed.rate / rate) if rate > 0 else 0
    if stride < 1 or (rate is not None and abs(stride * rate - observed.rate) > 1e-6):
        raise InputError(
            "rate",
            expected=f"{observed.rate:g} Hz, the data's rate, or a whole part of it",
            got=f"{rate}",
            remedy="the sensor's true rate serves best",
        )
    count = int(observed.mask[:, ::stride].sum())
    if count <= len(twin.parameters):
        raise InputError(
            "observed",
            expected=f"more measurements than parameters, {len(twin.parameters)}",
            got=f"{count}",
            remedy="give more trajectories, a higher rate, or free fewer parameters",
        )
    return stride


def check_counts(least: int = 1, **counts: int) -> None:
    """InputError, by its name, for anything but a whole number of at least `least`."""
    for name, value in counts.items():
        if not (isinstance(value, int | np.integer) and value >= least):
            raise InputError(
                name,
                expected=f"a whole number of at least {least}",
                got=repr(value),
                remedy="leave it out: the default serves well",
            )
