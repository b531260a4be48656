"""`Steps`: a model through time, compiled where there is a compiler, in torch with gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.twins.compiled.kernel import call, compiled
from retwin.twins.compiled.model import Model
from retwin.twins.interpolation import cubic_coefficients

__all__ = ["Steps"]


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

    """

    model: Model
    period: float
    substeps: int
    interpolation: str

    def run(self, commands: NDArray, theta: NDArray) -> tuple[NDArray, NDArray]:
        """Outputs (n, T, d_y) and states (n, T, d_x) for commands (n, T, d_u)."""
        library = compiled(self.model.source)
        if library is None:
            with torch.no_grad():
                given = (torch.tensor(each, dtype=torch.float64) for each in (commands, theta))
                outputs, states = self.in_torch(*given)
            return outputs.numpy(), states.numpy()
        widths = (len(self.model.outputs), len(self.model.slope))
        made = tuple(np.empty((*commands.shape[:2], width)) for width in widths)
        sizes = (*commands.shape[:2], self.substeps)
        call(library, "simulate", sizes, self.period, *self._arrays(commands, theta), *made)
        return made[0], made[1]

    def sensitivities(self, commands: NDArray, theta: NDArray) -> tuple[NDArray, NDArray]:
        """Outputs (n, T, d_y) and their derivatives (n, T, d_y, k) by `theta`."""
        library = compiled(self.model.source)
        count = theta.shape[1]
        if library is not None:
            outputs = np.empty((*commands.shape[:2], len(self.model.outputs)))
            made = (outputs, np.empty((*outputs.shape, count)))
            sizes = (*commands.shape[:2], self.substeps)
            given = self._arrays(commands, theta)
            call(library, "sensitivities", sizes, self.period, *given, *made)
            return made
        at, inputs = (torch.tensor(each, dtype=torch.float64) for each in (theta, commands))
        columns = [
            torch.autograd.functional.jvp(
                lambda own: self.in_torch(inputs, own)[0], at, unit.expand_as(at).clone()
            )
            for unit in torch.eye(count, dtype=torch.float64)
        ]
        return columns[0][0].numpy(), torch.stack([each for _, each in columns], -1).numpy()

    def in_torch(self, commands: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """The same as `run` for double tensors, with gradient by both."""
        c = cubic_coefficients(commands, self.interpolation)
        p, start = self._parted(theta.unbind(1))
        x, outputs, states = list(start), [], []
        for t in range(c.shape[1]):
            outputs.append(
                torch.stack(self.model.evaluate("outputs", x, c[:, t, 0].unbind(1), p), 1)
            )
            states.append(torch.stack(x, 1))
            if t + 1 < c.shape[1]:
                x = self._advanced(c[:, t], x, p)
        return torch.stack(outputs, 1), torch.stack(states, 1)

    def _advanced(self, c: Tensor, x: list[Tensor], p: Sequence[Tensor]) -> list[Tensor]:
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

    def _arrays(self, commands: NDArray, theta: NDArray) -> list[NDArray]:
        """Coefficients of the commands, parameters and starts, as the compiled model takes them."""
        given = torch.tensor(commands, dtype=torch.float64)
        c = cubic_coefficients(given, self.interpolation).numpy()
        columns = self._parted(list(theta.T))
        starts = [np.stack(own, 1) if own else np.zeros((len(theta), 0)) for own in columns]
        return [np.ascontiguousarray(each, np.float64) for each in (c, *starts)]

    def _parted(self, columns: Sequence) -> tuple[Sequence, Sequence]:
        """What belongs to the parameters, and to the starts."""
        count = len(self.model.variables["p"])
        return columns[:count], columns[count:]
