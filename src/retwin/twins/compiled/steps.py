"""`Steps`: a model through time, compiled where there is a compiler, in torch with gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.compiler import call, compiled
from retwin.twins.compiled.model import Model
from retwin.twins.equations.interpolation import cubic_coefficients, delayed


@dataclass(frozen=True, eq=False)
class Steps:
    """The simulation of a model from sample to sample.

    `theta`, (n, k), are the values of the model's parameters and then its states at the first
    sample, for each of n trajectories.

    Attributes
    ----------
    model : Model
        The traced equations.
    period : float
        Sample period in s.
    substeps : int
        Steps of the integration per sample.
    interpolation : str
        Of the commands between samples.
    delays : tuple of (int, int)
        Indices of the commands with a dead time, and of the parameters that are these.
    causal : bool
        Whether commands between samples depend on earlier samples and the next one alone, as while
        a system runs.

    """

    model: Model
    period: float
    substeps: int
    interpolation: str
    delays: tuple[tuple[int, int], ...] = ()
    causal: bool = False

    def run(
        self,
        commands: NDArray,
        theta: NDArray,
        kicks: NDArray | None = None,
        changes: NDArray | None = None,
        first: int = 0,
    ) -> tuple[NDArray, NDArray]:
        """Outputs (n, T, d_y) and states (n, T, d_x) for commands (n, T, d_u).

        `kicks` (n, T, d_x), contiguous, are added to the states after each sample: process noise.
        `changes` (n, T, q), contiguous, are added to the q parameters until the next sample. So
        many commands as `first` are before the first sample; the interpolation passes through them.
        """
        library = compiled(self.model.source)
        if library is None:
            with torch.no_grad():
                inputs, values = _double(commands), _double(theta)
                outputs, states = self.in_torch(inputs, values, kicks, changes, first)
            return outputs.numpy(), states.numpy()
        shape = len(commands), commands.shape[1] - first
        made = tuple(np.empty((*shape, width)) for width in self._widths)
        given = (*self._arrays(commands, theta, first), kicks, changes, *made)
        call(library, "simulate", (*shape, self.substeps), self.period, (), given)
        return made[0], made[1]

    def filter(
        self,
        commands: NDArray,
        theta: NDArray,
        measured: tuple[NDArray, NDArray],
        spread: NDArray,
        variances: tuple[NDArray, NDArray],
        changes: NDArray | None = None,
        first: int = 0,
        gate: float = np.inf,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """The extended Kalman filter.

        Parameters
        ----------
        commands, theta, changes, first
            See `run`.
        measured : tuple of NDArray
            Outputs (n, T, d_y), and whether each was measured.
        spread : NDArray
            Covariances (n, d_x, d_x) of the states at the first sample, before it is measured.
        gate : float
            An output with an error of more standard deviations than this is not used.
        variances : tuple of NDArray
            Of the process noise after each sample, (d_x,) or (n, T, d_x), and of the measurement
            noise (d_y,), above 0.

        Returns
        -------
        mean, covariance, states, spread : NDArray
            Mean (n, T, d_y) and covariance (n, T, d_y, d_y) of the outputs given all earlier
            samples, and the states (n, T, d_x) given the present one too, with their covariances
            (n, d_x, d_x) at the last sample.

        """
        library = compiled(self.model.source)
        shape = len(commands), commands.shape[1] - first
        outputs, states = self._widths
        process, common = variances[0], (variances[1], np.array([gate]))
        process = np.broadcast_to(process, (*shape, states))
        if library is None:
            c = self.coefficients(_double(commands), _double(theta), first).numpy()
            if changes is None:
                changes = np.zeros((*c.shape[:2], len(self.model.variables["p"])))
            given = zip(c, theta, process, *measured, changes, spread, strict=True)
            every = [self._filter_row(*row, *common) for row in given]
            mean, covariance, x, after = (np.stack(each) for each in zip(*every, strict=True))
            return mean, covariance, x, after
        after = np.array(spread, np.float64)
        made = tuple(
            np.empty((*shape, *each)) for each in ((outputs,), (outputs, outputs), (states,))
        )
        shared, seen = (
            [np.ascontiguousarray(each, np.float64) for each in own]
            for own in (common, (process, *measured))
        )
        rows = (*self._arrays(commands, theta, first), *seen, changes, after, *made)
        call(library, "filter", (*shape, self.substeps), self.period, shared, rows)
        return made[0], made[1], made[2], after

    def _filter_row(self, *row: NDArray) -> list[NDArray]:
        """See `filter`, for one trajectory."""
        c, theta, process, outputs, seen, changes, spread, noise, gate = map(_double, row)
        constant, start = self._split(theta[:, None].unbind(0))
        x = torch.cat(list(start))
        made = []
        for t, (y, known) in enumerate(zip(outputs, seen > 0, strict=True)):
            now = [own + change for own, change in zip(constant, changes[t], strict=True)]

            def output(z: Tensor, t: int = t, p: Sequence[Tensor] = now) -> Tensor:
                u = c[None, t, 0].unbind(1)
                return torch.cat(self.model.evaluate("outputs", z[:, None].unbind(0), u, p))

            def after(z: Tensor, t: int = t, p: Sequence[Tensor] = now) -> Tensor:
                return torch.cat(self._advance(c[None, t], list(z[:, None].unbind(0)), p))

            slope = torch.autograd.functional.jacobian(output, x)
            factor = _factor(spread)
            by = slope @ factor
            mean, predicted = output(x), by @ by.T + torch.diag(noise)
            centre, used = x, False
            for h, r, error in zip(slope[known], noise[known], (y - mean)[known], strict=True):
                f = h @ factor
                variance = f @ f + r
                error = error - h @ (x - centre)
                if error.abs() > gate * variance.sqrt():
                    continue
                column, used = factor @ f, True
                x = x + column * error / variance
                factor = factor - torch.outer(column, f) / (variance + (r * variance).sqrt())
            if used:
                spread = factor @ factor.T
            made.append((mean, predicted, x))
            if t + 1 < len(outputs):
                forward = torch.autograd.functional.jacobian(after, x)
                x = after(x)
                spread = forward @ spread @ forward.T + torch.diag(process[t])
        stacked = [torch.stack(each).numpy() for each in zip(*made, strict=True)]
        return [*stacked, spread.numpy()]

    def sensitivities(self, commands: NDArray, theta: NDArray) -> tuple[NDArray, NDArray]:
        """Outputs (n, T, d_y) and their derivatives (n, T, d_y, k) by `theta`."""
        library = compiled(self.model.source)
        count = theta.shape[1]
        if library is not None:
            outputs = np.empty((*commands.shape[:2], len(self.model.outputs)))
            made = (outputs, np.empty((*outputs.shape, count)))
            sizes = (*commands.shape[:2], self.substeps)
            given = self._arrays(commands, theta)
            call(library, "sensitivities", sizes, self.period, (), (*given, *made))
            return made
        at, inputs = _double(theta), _double(commands)
        columns = [
            torch.autograd.functional.jvp(
                lambda own: self.in_torch(inputs, own)[0], at, unit.expand_as(at).clone()
            )
            for unit in torch.eye(count, dtype=torch.float64)
        ]
        return columns[0][0].numpy(), torch.stack([each for _, each in columns], -1).numpy()

    def in_torch(
        self,
        commands: Tensor,
        theta: Tensor,
        kicks: NDArray | None = None,
        changes: NDArray | None = None,
        first: int = 0,
    ) -> tuple[Tensor, Tensor]:
        """The same as `run` for double tensors, with gradient by both."""
        c = self.coefficients(commands, theta, first)
        p, start = self._split(theta.unbind(1))
        constant = p
        x, outputs, states = list(start), [], []
        for t in range(c.shape[1]):
            if changes is not None:
                now = _double(changes[:, t].T)
                p = [own + change for own, change in zip(constant, now, strict=True)]
            outputs.append(
                torch.stack(self.model.evaluate("outputs", x, c[:, t, 0].unbind(1), p), 1)
            )
            states.append(torch.stack(x, 1))
            if t + 1 < c.shape[1]:
                x = self._advance(c[:, t], x, p)
            if kicks is not None:
                x = [own + kick for own, kick in zip(x, _double(kicks[:, t].T), strict=True)]
        return torch.stack(outputs, 1), torch.stack(states, 1)

    def coefficients(self, commands: Tensor, theta: Tensor, first: int = 0) -> Tensor:
        """Polynomials (n, T, 4, .) of the model's commands from each sample to the next."""
        if self.delays:
            places, parameters = (list(each) for each in zip(*self.delays, strict=True))
            commands = delayed(commands, places, theta[:, parameters], self.period)
        made = cubic_coefficients(commands, self.interpolation, causal=self.causal)
        return made[:, first:]

    def acting(self, commands: NDArray, theta: NDArray) -> NDArray:
        """Commands (n, T, d_u) as they act at each sample, after their dead times."""
        if not self.delays:
            return commands
        c = self.coefficients(_double(commands), _double(theta))[:, :, 0].numpy()
        made, moved = c[..., : commands.shape[2]], c[..., commands.shape[2] :]
        for k, (place, parameter) in enumerate(self.delays):
            made[..., place] += theta[:, parameter, None] * moved[..., k]
        return made

    def _advance(self, c: Tensor, x: list[Tensor], p: Sequence[Tensor]) -> list[Tensor]:
        """The states one sample later."""
        if self.model.discrete:
            return self.model.evaluate("slope", x, c[:, 0].unbind(1), p)
        h = self.period / self.substeps
        for number in range(self.substeps):
            slopes: list[list[Tensor]] = []
            for shift in (0.0, 0.5, 0.5, 1.0):
                s = (number + shift) / self.substeps
                u = (c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))).unbind(1)
                last = slopes[-1] if slopes else [torch.zeros_like(a) for a in x]
                at = [a + shift * h * k for a, k in zip(x, last, strict=True)]
                slopes.append(self.model.evaluate("slope", at, u, p))
            x = [
                a + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
                for a, k in zip(x, zip(*slopes, strict=True), strict=True)
            ]
        return x

    def _arrays(self, commands: NDArray, theta: NDArray, first: int = 0) -> list[NDArray]:
        """Coefficients of the commands, parameters and starts, as the compiled model takes them."""
        c = self.coefficients(_double(commands), _double(theta), first).numpy()
        columns = self._split(list(theta.T))
        starts = [np.stack(own, 1) if own else np.zeros((len(theta), 0)) for own in columns]
        return [np.ascontiguousarray(each, np.float64) for each in (c, *starts)]

    @property
    def _widths(self) -> tuple[int, int]:
        """Numbers of outputs and of states."""
        return len(self.model.outputs), len(self.model.slope)

    def _split(self, columns: Sequence) -> tuple[Sequence, Sequence]:
        """What belongs to the parameters, and to the starts."""
        count = len(self.model.variables["p"])
        return columns[:count], columns[count:]


def _double(values: NDArray) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _factor(covariance: Tensor) -> Tensor:
    """A factor S of S S^T, which may be singular; NaN where the covariance is not finite."""
    if not covariance.isfinite().all():
        return torch.full_like(covariance, torch.nan)
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp_min(0.0).sqrt()
