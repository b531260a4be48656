"""`Misfit`: measured minus simulated outputs for many values of the parameters at once."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessPool

from retwin.checks import require, whole
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.equations.step_error import StepWarning
from retwin.twins.twin import checked_seed, checked_stride
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics.windows import Windows, sampled, state_based, windows_of
from retwin.workers.pools import sendable_errors, worker_pool


class Misfit:
    """Residuals of a twin on measured trajectories, at the samples that the sensor took.

    Residuals are in units of `unit`: 1 where all outputs share a physical unit, so that the norm is
    that of Eq. 2; otherwise the standard deviation of each output at the twin's present values.

    Parameters
    ----------
    twin : ParametricTwin
        The twin at its present values.
    observed : Trajectories
        Measured healthy trajectories.
    stride : int
        Every how many samples residuals are computed.
    seed : int
        Seed of the simulations.
    pool : ProcessPool, optional
        Worker processes, over which values of the parameters are distributed.
    processes : int
        Number of these.
    windows : Windows, optional
        Where the starts of simulations are estimated; otherwise they are those of the twin.

    Attributes
    ----------
    measured : NDArray
        (n, P, d_y), the outputs in physical units.
    seen : NDArray
        (n, P, d_y) bool, the measured samples.
    unit : NDArray
        (d_y,), physical units per unit of a residual.
    spread : float
        Standard deviation of the twin's outputs over `unit`, the scale of a large residual; of
        those that were measured.
    low, high : NDArray
        (k,), bounds of the parameters.
    present : NDArray
        (n, P, d_y), outputs at the present values.
    twin_runs : int
        Trajectories simulated so far.

    Raises
    ------
    InputError
        The simulation fails at the present values.

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
        windows: Windows | None = None,
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
        self.windows = windows
        self._commands = observed.commands.astype(np.float64)
        self.measured = observed.observed[:, ::stride].astype(np.float64)
        self.present = self.outputs(np.array([twin.values]))[0]
        if np.isnan(self.present).any():
            with suppress(SimulationError):  # what the twin itself refuses has a better message
                twin.simulate(self._commands, seed=seed)
        expected = "one that can simulate the commands at its present values"
        got = "a simulation that failed"
        remedy = "choose other starts of the parameters"
        require(not np.isnan(self.present).any(), "twin", expected=expected, got=got, remedy=remedy)
        each = self.present.std(axis=(0, 1))
        alike = len(set(observed.outputs.units)) == 1
        self.unit = np.ones(len(each)) if alike else np.maximum(each, 1e-12)
        if windows is not None:
            self.unit = windows.unit
        known = self.seen.any(axis=(0, 1))
        self.spread = float(np.sqrt(np.mean((each / self.unit)[known] ** 2)))

    @property
    def interval(self) -> float:
        """Seconds between the samples of the residuals."""
        return self.stride / self.observed.rate

    @property
    def rms(self) -> float:
        """Root mean square of the residuals at the present values."""
        return self.rms_of(self.residuals_of(self.present[None]))

    def outputs(self, theta: NDArray) -> NDArray:
        """Simulated outputs (m, n, P, d_y) at parameters (m, k); NaN where a simulation failed."""
        self.twin_runs += len(theta) * len(self._commands)
        if self.windows is not None:
            return np.stack([self.windows.outputs(own) for own in theta])[:, :, :: self.stride]
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
        """Residuals (m, n, P, d_y) of simulated outputs; 0 where nothing was measured."""
        return np.where(self.seen, (self.measured - outputs) / self.unit, 0.0)

    def derivatives(self, theta: NDArray) -> NDArray | None:
        """Derivatives (n P d_y, k) of the residuals at parameters (k,).

        None where the twin gives none that are finite.
        """
        with np.errstate(all="ignore"):  # simulations that run away have none
            made = (
                self.twin.sensitivities(self._commands, theta)
                if self.windows is None
                else self.windows.derivatives(theta)
            )
        if made is None or not np.isfinite(made).all():
            return None
        self.twin_runs += len(self._commands)
        made = made[:, :: self.stride] / self.unit[:, None]
        return np.where(self.seen[..., None], -made, 0.0).reshape(-1, len(theta))

    def rms_of(self, residual: NDArray) -> float:
        """Root mean square of residuals (n, P, d_y) over the measured samples."""
        return float(np.sqrt(np.sum(residual**2) / self.seen.sum()))


@contextmanager
def misfit_of(
    twin: ParametricTwin,
    observed: Trajectories,
    *,
    seed: int,
    rate: float | None,
    processes: int,
    length: int | None = None,
    own: bool = False,
) -> Iterator[Misfit]:
    """The misfit of a twin, with worker processes during the block if `processes` exceeds 1.

    The starts of windows of `length` samples, or those of whole records that are not given, are
    estimated if the twin has states; with `own`, unstated starts of each whole record too.

    Raises InputError if twin and data do not fit each other.
    """
    checked_seed(seed)
    whole("processes", processes, at_least=1)
    stride = _check_data(twin, observed, rate)
    windows = None
    if state_based(twin):
        windows = windows_of(twin, observed, length, sampled(observed.mask, stride), own=own)
    if processes == 1 or windows is not None:
        yield Misfit(twin, observed, stride=stride, seed=seed, windows=windows)
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
        with warnings.catch_warnings():
            # A search passes values that no twin needs to be exact at.
            warnings.simplefilter("ignore", StepWarning)
            observed = twin.simulate(repeated, seed=seed, parameters=values).observed
    except SimulationError as error:
        # Parameters within the bounds can be beyond what the twin can simulate.
        observed = np.full((*repeated.shape[:2], len(twin.outputs)), np.nan)
        observed[error.finished.ids.astype(int)] = error.finished.observed
    except InputError:
        # So a function fails whose outputs are not finite.
        if len(theta) > 1:
            return np.concatenate([_outputs(twin, commands, stride, seed, e[None]) for e in theta])
        observed = np.full((*repeated.shape[:2], len(twin.outputs)), np.nan)
    made = observed[:, ::stride].astype(np.float64)
    return made.reshape(len(theta), each, *made.shape[1:])


def _in_worker(
    twin: ParametricTwin, commands: NDArray, stride: int, seed: int, theta: NDArray
) -> NDArray:
    with sendable_errors():
        return _outputs(twin, commands, stride, seed, theta)


def _check_data(twin: ParametricTwin, observed: Trajectories, rate: float | None) -> int:
    """The stride of the residuals; InputError if twin and data do not fit each other."""
    expected = "a ParametricTwin, which declares its free parameters"
    got = type(twin).__name__
    remedy = "see ParametricTwin, CommandSide and ParametricTwin.built"
    require(isinstance(twin, ParametricTwin), "twin", expected=expected, got=got, remedy=remedy)
    stride = checked_stride(twin, observed, rate, "observed")
    count = int(observed.mask[:, ::stride].sum())
    expected = f"more measurements than parameters, {len(twin.parameters)}"
    remedy = "give more trajectories, a higher rate, or free fewer parameters"
    require(count > len(twin.parameters), "observed", expected=expected, got=count, remedy=remedy)
    return stride
