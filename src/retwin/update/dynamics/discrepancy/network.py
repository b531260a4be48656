"""`TanhNetwork`: a network with one hidden layer, as a discrepancy of a state equation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from retwin.checks import whole
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.terms import WIDEST, Term

__all__ = ["TanhNetwork"]


@dataclass(frozen=True)
class TanhNetwork:
    """A constant and a weighted sum of hidden units tanh(b + w v) of an equation's variables v.

    It is 0 at the start: the weights of the sum are, and the weights inside the units are drawn.
    The variables are scaled: an excursion of 1 is half the range that they had in calibration.

    Parameters
    ----------
    hidden : int, default 8
        Number of units per corrected equation.
    seed : int, default 0
        Seed of the weights inside the units.

    """

    hidden: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        whole("hidden", self.hidden, at_least=1)
        whole("seed", self.seed, at_least=0)

    def terms(
        self,
        variables: Sequence[str],
        states: int,
        signs: Sequence[int],
        zeros: Sequence[float] = (),
    ) -> list[Term]:
        """The constant and the units, see `Library.terms`; `zeros` do not matter.

        tanh is odd, so that a unit may have a positive weight without loss of generality. A network
        of such units is monotone in a variable whose inner weights have one sign (Sill, "Monotonic
        networks", 1997).
        """
        rng = np.random.default_rng(self.seed)
        made = Library(0, (), False).terms(variables, states, signs)
        for number in range(1, self.hidden + 1):
            # Usual norm of the weights inside a unit: it passes from -1 to 1 within the domain.
            weights = 2.0 * rng.normal(size=len(variables)) / np.sqrt(len(variables))
            weights = np.where(signs, np.abs(weights) * signs, weights)
            bias = -float(weights @ rng.uniform(-1, 1, size=len(variables)))
            name = f"unit {number}"
            inner = [Parameter(f"{name} bias", "1", -WIDEST, WIDEST, bias)]
            for each, weight, sign in zip(variables, weights.tolist(), signs, strict=True):
                low, high = 0.0 if sign > 0 else -WIDEST, 0.0 if sign < 0 else WIDEST
                inner.append(Parameter(f"{name} {each}", "1", low, high, weight))
            low = 0.0 if any(signs) else -WIDEST
            made.append(Term(name, _unit, tuple(signs), tuple(inner), low))
        return made


def _unit(v: Sequence[Any], bias: Any, *weights: Any) -> Any:
    return torch.tanh(sum((w * each for w, each in zip(weights, v, strict=True)), bias))
