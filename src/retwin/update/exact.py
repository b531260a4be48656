"""`ExactSurrogate`: a twin itself in place of a surrogate, without a network's error."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.checks import require
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.twin import Twin
from retwin.twins.wrapper import OfTwin
from retwin.update.surrogate import Surrogate


class ExactSurrogate(OfTwin):
    """A twin with the methods of a surrogate that corrections and residual models use.

    A twin that can be called with a tensor, such as a torch module or a `StateTwin`, is
    differentiated through its call. Of any other twin, and of these where no gradient is needed,
    `CommandSpace` takes finite differences, each of which is a simulation.

    Parameters
    ----------
    twin : Twin
        Its nominal outputs stand for those of a surrogate.
    differences : bool
        Whether a warning on the cost of finite differences is given at the first call.

    """

    twin: Twin
    memoryless = False
    """Whether an output depends on the command of its own sample only: of a twin it is unknown."""

    def __init__(self, twin: Twin, *, differences: bool) -> None:
        self.twin = twin
        self._warns = differences

    def predict(self, commands: NDArray, *, progress: Progress | None = None) -> NDArray:
        """The nominal outputs (n, T, d_y), float32, for commands (n, T, d_u)."""
        made = self.twin.simulate(np.asarray(commands, np.float64), seed=0, progress=progress)
        return made.nominal.astype(np.float32)

    def __call__(self, commands: Tensor) -> Tensor:
        """The same for a tensor; with gradient if the twin can be called with one."""
        differentiated = torch.is_grad_enabled() and commands.requires_grad
        if isinstance(self.twin, nn.Module) or (differentiated and callable(self.twin)):
            return self.twin(commands)
        require(
            not differentiated,
            "surrogate",
            expected="a twin that is a torch module or a StateTwin, to be differentiated",
            got=type(self.twin).__name__,
            remedy="fit a surrogate to it (fit_surrogate), or leave refinement out",
        )
        if self._warns:
            self._warns = False
            warnings.warn(
                f"{type(self.twin).__name__} in place of a surrogate: each step of the inference "
                "simulates it once per component of z; a surrogate (fit_surrogate) is faster",
                stacklevel=2,
            )
        return torch.as_tensor(self.predict(commands.numpy()))

    def save(self, folder: str | Path) -> None:
        """Refuse: loading a twin would run code."""
        raise InputError(
            "surrogate",
            expected="a fitted surrogate, to be saved",
            got=type(self.twin).__name__,
            remedy="fit one with fit_surrogate, or save the residual model alone",
        )


def exact_surrogate(given: Surrogate | Twin, *, differences: bool = True) -> Surrogate:
    """A surrogate as it is, any other twin as an `ExactSurrogate` with that setting.

    Raises
    ------
    InputError
        The object is no twin.

    """
    if hasattr(given, "predict"):
        return given  # type: ignore[return-value]
    require(
        isinstance(given, Twin),
        "surrogate",
        expected="a surrogate, or a twin with inputs, outputs, rate and simulate",
        got=type(given).__name__,
        remedy="fit a surrogate with fit_surrogate",
    )
    return ExactSurrogate(given, differences=differences)  # type: ignore[return-value]
