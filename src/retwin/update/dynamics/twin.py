"""`DynamicsTwin`: a twin with corrected state equations, as a distribution."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state_twin import SAMPLES_PER_CHUNK, StateTwin
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, check_channels, checked_commands, simulate_in_chunks
from retwin.twins.wrappers.wrapper import TwinWrapper, chunk_generator
from retwin.update.dynamics.discrepancy.curves import Curve, axes_of, curve_of
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.estimation import estimate_starts
from retwin.update.dynamics.filter.filtering import DynamicsFilter
from retwin.update.dynamics.filter.prediction import Prediction
from retwin.update.dynamics.saved import KIND, read_fields, write_fields
from retwin.update.dynamics.simulation import FreeSimulation
from retwin.update.dynamics.unknowns import Unknowns, unknowns_of
from retwin.update.forecast_errors import ForecastErrors
from retwin.update.training_range import OutsideTrainingWarning

__all__ = ["DynamicsTwin"]

BEYOND = 0.05
"""How far, in widths of the domain, states and commands may leave it without a warning."""


@dataclass(frozen=True, eq=False)
class DynamicsTwin(TwinWrapper):
    """A twin with a learned discrepancy inside its state equations, and with noise.

        x[k+1] = F(x[k], u[k]; theta) + delta(x[k], u[k]; psi) + w[k],   y[k] = h(x[k]) + v[k]

    Each simulated trajectory has parameters theta and psi drawn from their posterior, a start of
    its own, process noise w and measurement noise v. The nominal outputs are the most probable
    ones, without noise.

    Attributes
    ----------
    equations : StateTwin
        The corrected equations; theta and psi are its parameters.
    values : NDArray
        (q + d_x,), their most probable values, and those of the states at the first sample.
    factor : NDArray
        (q + d_x, r), of the posterior covariance of `values`, factor @ factor.T.
    start_deviation : NDArray
        (d_x,), by which starts differ between trajectories.
    process, proportional, noise : NDArray
        (d_x,), (d_x,) and (d_y,). The variance of w is `process`, plus `proportional` times the
        square of the change that the commands alone make in that sample (`DynamicsFilter`); that
        of v is `noise`.
    free_process : NDArray
        (d_x,), the variance of w in free simulation, which is constant: errors that are new in each
        sample, as those after a switch seem to be, cancel each other over many.
    widening : NDArray
        (d_y,), factors of the deviations from the most probable outputs, from held-out blocks.
    constant : NDArray
        (d_y,), standard deviations in free simulation of outputs that have the same at all times,
        because held-out errors do not grow as the propagated uncertainty does; 0 for others.
    domain : Domain
        The range of states and commands in calibration.
    corrected : tuple of str
        The states whose equations have a discrepancy.
    emulated : bool
        Whether the calibration data were emulated.
    case : str
        The name of the case that it was fitted for; the command line reads it.
    forecast : ForecastErrors, optional
        Errors of predictions from measurements, by how far ahead; None where none were calibrated.

    """

    equations: StateTwin
    values: NDArray
    factor: NDArray
    start_deviation: NDArray
    process: NDArray
    proportional: NDArray
    free_process: NDArray
    noise: NDArray
    widening: NDArray
    constant: NDArray
    domain: Domain
    corrected: tuple[str, ...]
    emulated: bool = False
    case: str = ""
    forecast: ForecastErrors | None = None
    kind: ClassVar[str] = KIND
    _field: ClassVar[str] = "equations"

    @property
    def filter(self) -> DynamicsFilter:
        """The extended Kalman filter, on arrays."""
        return DynamicsFilter(**_fields_for(DynamicsFilter, self))

    @property
    def simulation(self) -> FreeSimulation:
        """Simulations from commands alone, on arrays."""
        return FreeSimulation(**_fields_for(FreeSimulation, self))

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`. A stuck actuator is a held command.

        Warns
        -----
        OutsideTrainingWarning
            Most probable states, or commands, leave the range that they had in calibration.
        StepWarning
            See `StateTwin`.

        """
        beyond = np.zeros(len(self.domain.low))

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            held = np.asarray(chunk.held_commands, np.float64)
            clean = np.asarray(chunk.commands, np.float64)
            nominal, states = self.simulation.most_probable(clean)
            np.maximum(beyond, self.domain.excess(states, clean), out=beyond)
            if chunk.index.start == 0 and np.isfinite(states[0]).all():
                self.equations.check_accuracy(clean[:1], self.values[None], nominal[:1])
            changes = self.equations.changes(chunk.faults, clean.shape[1])
            return nominal, self.simulation.drawn(held, changes, chunk_generator(seed, chunk, 2))

        checked = checked_commands(commands, self.inputs)
        size = max(1, SAMPLES_PER_CHUNK // checked.shape[1])
        made = simulate_in_chunks(
            self,
            run,
            checked,
            faults,
            seed=seed,
            progress=progress,
            size=size,
            emulated=self.emulated,
        )
        self._warn(beyond)
        return made

    def started(self, record: Trajectories) -> DynamicsTwin:
        """The twin with the unknown starts of one record, inferred from its first samples.

        The parameters are held, and the errors of samples count as independent. It simulates this
        record only.

        Parameters
        ----------
        record : Trajectories
            One trajectory; its measured samples are a warm-up (`Trajectories.between`).

        Returns
        -------
        DynamicsTwin
            With the most probable starts, and their uncertainty.

        Raises
        ------
        InputError
            Not one trajectory, other channels or another rate, nothing measured, or states whose
            starts are all known.

        """
        check_channels(self, record, "record")
        unknowns = self._starts
        commands = record.commands.astype(np.float64)
        variance = self.simulation.noise_variance(commands).mean(axis=(0, 1))
        starts, uncertain = estimate_starts(self.equations, record, unknowns, variance)
        states = len(self.process)
        values, factor = self.values.copy(), self.factor.copy()
        values[-states:][unknowns.free] = starts
        factor[-states:] = 0.0
        own = np.zeros((len(values), len(unknowns.free)))
        own[len(values) - states + unknowns.free] = uncertain
        factor = np.concatenate([factor, own], axis=1)
        return replace(self, values=values, factor=factor, start_deviation=np.zeros(states))

    @property
    def unknown_starts(self) -> bool:
        """Whether it has a state whose start is not known, which `started` infers."""
        return len(self._starts.free) > 0

    @property
    def _starts(self) -> Unknowns:
        """The starts of the states, as unknowns, beside the parameters as estimated."""
        present = dict(zip(self.equations.names, self.values.tolist(), strict=True))
        return unknowns_of(self.equations, (), present)

    def predictive(self, record: Trajectories) -> Prediction:
        """The distribution of each sample of a record given all earlier ones.

        An extended Kalman filter, with the uncertainty of the parameters, of which the record
        removes a part (`Prediction.marginal`). Samples that are masked are not used, so a record
        whose mask ends after a warm-up is simulated from there on. An unknown start has the
        variance of a uniform distribution between its bounds.

        Parameters
        ----------
        record : Trajectories
            Measured outputs, with their commands.

        Returns
        -------
        Prediction
            Gaussian distributions.

        Raises
        ------
        InputError
            Other channels or another rate than those of the twin, or a trajectory with which the
            filter is not finite.

        Warns
        -----
        OutsideTrainingWarning
            See `simulate`.

        """
        check_channels(self, record, "record")
        given = self._given(record)
        made = Prediction(record, *self.filter(*given)).marginal(self.filter.slopes(*given))
        parts = (made.mean, made.covariance, made.states)
        good = np.all([np.isfinite(each).reshape(len(record), -1).all(1) for each in parts], 0)
        expected = "commands and outputs with which the filter stays finite"
        got = f"trajectories {np.flatnonzero(~good)[:5].tolist()} with which it does not"
        remedy = "leave them out, or give more substeps"
        require(good.all(), "record", expected=expected, got=got, remedy=remedy)
        self._warn(self.domain.excess(made.states, record.commands))
        return made

    def _given(self, record: Trajectories) -> tuple[NDArray, NDArray, NDArray]:
        """Commands, outputs and whether these were measured, as `filter` takes them."""
        commands = checked_commands(record.commands, self.inputs).astype(np.float64)
        return commands, np.where(record.mask, record.observed, 0.0), record.mask

    @property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """Values (d_x + d_u,) of states and commands beyond which `simulate` warns."""
        margin = BEYOND * self.domain.width
        return self.domain.low - margin, self.domain.high + margin

    def outside(self, commands: NDArray) -> NDArray:
        """Whether commands (n, T, d_u) leave the range that they had in calibration: (n,) bool."""
        low, high = (each[len(self.process) :] for each in self.bounds)
        beyond: NDArray = (commands < low) | (commands > high)
        return np.asarray(beyond.any(axis=(1, 2)))

    def slope(self, states: NDArray, commands: NDArray, changes: NDArray | None = None) -> NDArray:
        """Most probable time derivatives of the states, or the states one sample later.

        Parameters
        ----------
        states, commands : ndarray, shapes (K, d_x) and (K, d_u)
            Where they are evaluated.
        changes : ndarray, shape (K, q), optional
            What is added to the parameters.

        Returns
        -------
        ndarray, shape (K, d_x)
            Per s, or the states themselves for a twin with a `step`.

        """
        x, u = (
            list(torch.tensor(each, dtype=torch.float64).unbind(1)) for each in (states, commands)
        )
        values = np.tile(self.values[: -len(self.process)], (len(states), 1))
        p = list(torch.tensor(values if changes is None else values + changes).unbind(1))
        return torch.stack(self.equations.model.evaluate("slope", x, u, p), 1).numpy()

    @property
    def axes(self) -> list[tuple[str, str]]:
        """Equations and variables that `curve` takes."""
        return axes_of(self.equations, self.corrected)

    def curve(
        self, equation: str, variable: str, *, relative_to: Mapping[str, float] | None = None
    ) -> Curve:
        """The learned discrepancy of a state equation over one variable, with its uncertainty.

        Parameters
        ----------
        equation : str
            A state of `corrected`.
        variable : str
            A state or a command on which that equation depends ("command NAME" for a command with
            the name of a state). The others are at their means over the calibration.
        relative_to : mapping of str to float, optional
            Parameters of the twin without discrepancy that the corrected equation is compared with,
            those left out as estimated. By default, delta alone: all as estimated. Parameters and
            delta share the work, so what is known best is the difference to given parameters.

        Raises
        ------
        InputError
            Another equation, variable or parameter.

        """
        posterior = (self.values[: -len(self.process)], self.factor[: -len(self.process)])
        axes = (equation, variable)
        return curve_of(self.equations, posterior, self.domain, self.corrected, axes, relative_to)

    def _warn(self, beyond: NDArray) -> None:
        """Warn where a state or a command leaves the domain by so much (d_x + d_u,)."""
        worst = int(np.argmax(beyond))
        if beyond[worst] <= BEYOND:
            return
        names = (*(each.name for each in self.equations.states), *self.inputs.names)
        warnings.warn(
            f"{names[worst]} leaves the range that it had in calibration by "
            f"{100 * beyond[worst]:.3g} % of its width; there the discrepancy is extrapolated",
            OutsideTrainingWarning,
            stacklevel=3,
        )

    def save(self, folder: str | Path) -> None:
        """Write the equations, as operations on numbers, with all values."""
        write_fields(folder, vars(self))

    @classmethod
    def load(cls, folder: str | Path) -> DynamicsTwin:
        """Read what `save` wrote; no code of the twin is needed.

        Raises InputError if the folder holds no such model or is damaged.
        """
        return cls(**read_fields(folder))


def _fields_for(kind: type[Any], twin: DynamicsTwin) -> dict[str, Any]:
    """The fields of a twin that a part of it has too, by name."""
    return {each.name: getattr(twin, each.name) for each in fields(kind)}
