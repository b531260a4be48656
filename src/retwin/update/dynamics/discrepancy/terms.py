"""`Term`: a function of which the discrepancy of a state equation is a weighted sum."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from retwin.twins.wrappers.parametric import Parameter

__all__ = ["WIDEST", "Term", "allowed"]

WIDEST = 1e9
"""Bound of coefficients without one, which their prior or the samples keep much smaller."""


@dataclass(frozen=True)
class Term:
    """A function of the variables of an equation, and its weight, a coefficient.

    Attributes
    ----------
    name : str
        How it is written in tables.
    value : callable
        From the scaled variables and the inner coefficients, scalar tensors, to a scalar tensor.
    directions : sequence of int or None
        Per variable: 1 where the function is non-decreasing in it whatever the others are, -1 where
        it is non-increasing, 0 where it does not depend on it, None for anything else.
    inner : tuple of Parameter
        Further coefficients inside the function. Their starts are the means of their prior.
    low, high : float
        Bounds of the weight.

    """

    name: str
    value: Callable[..., Any]
    directions: Sequence[int | None]
    inner: tuple[Parameter, ...] = ()
    low: float = -WIDEST
    high: float = WIDEST

    @property
    def weight(self) -> Parameter:
        """The weight as a parameter: 0 at the start."""
        return Parameter(self.name, "1", self.low, self.high, 0.0)


def allowed(terms: Iterable[Term], signs: Sequence[int]) -> Iterator[Term]:
    """The terms of a sum that is monotone, with bounds of their weights.

    A term is left out unless one sign of its weight is right for all variables: then any sum of
    terms is monotone, over all values of the variables. This is sufficient, not necessary.

    Parameters
    ----------
    terms : iterable of Term
        The terms.
    signs : sequence of int
        Per variable: 1 where the sum must be non-decreasing, -1 where non-increasing, 0 where it
        is free.

    """
    for term in terms:
        pairs = [(a, b) for a, b in zip(term.directions, signs, strict=True) if b and a != 0]
        needed = {None if a is None else a * b for a, b in pairs}
        if not needed:
            yield term
        elif needed == {1}:
            yield replace(term, low=0.0)
        elif needed == {-1}:
            yield replace(term, high=0.0)
