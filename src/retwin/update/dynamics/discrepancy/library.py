"""`Library`: readable terms of which the discrepancy of a state equation is a weighted sum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations_with_replacement, product
from math import comb, prod
from typing import Any

import torch

from retwin.arrays import floats
from retwin.checks import one_of, require, whole
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.terms import Term, allowed

__all__ = ["Library"]

WIDTH = 0.05
"""Usual width of the smooth sign function of Coulomb friction, in half ranges of its variable."""
WIDTHS = (-4.0, 3.0)
"""Bounds of the logarithm of its ratio to the usual one: from a thousandth of the half range to all
of it."""
SHIFTS = (-2.0, 2.0)
"""Bounds of its ratio to the usual one: those of the next knots."""


@dataclass(frozen=True)
class Library:
    """Terms whose weighted sum is the discrepancy of a state equation.

    The variables are scaled: an excursion of 1 is half the range that they had in calibration.

    Parameters
    ----------
    degree : int, default 3
        Highest degree of the monomials, which include products of different variables. It is
        lowered for equations of so many variables that there would be more than 200.
    knots : sequence of float
        Usual places of hinges max(0, v - knot) and max(0, -v - knot) of each variable v, from 0 to
        1: a piecewise linear function, for saturation, dead zones and overflow. They are 0 in the
        middle, where the twin's own equations hold best. The places are estimated, but one of 0.
    friction : bool, default True
        Whether Coulomb and quadratic friction, sign(v) and v |v|, of each state are included. They
        change sign where the state is 0, in its own unit. The sign function is smooth; its width,
        which is that of a motion near 0 or of lubrication, is estimated.
    sticking : bool, default True
        Whether friction may also hold a state, see `dead_zone`; not without `friction`.

    """

    degree: int = 3
    knots: Sequence[float] = (0.0, 0.4, 0.8)
    friction: bool = True
    sticking: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "knots", floats(self.knots))
        whole("degree", self.degree, at_least=0)
        one_of("friction", self.friction, (True, False))
        one_of("sticking", self.sticking, (True, False))
        inside = all(0 <= knot <= 1 for knot in self.knots)
        expected = "places from 0 to 1, the end of the range in calibration"
        got = ", ".join(f"{knot:g}" for knot in self.knots)
        remedy = "a hinge outside that range is not determined by the data"
        require(inside, "knots", expected=expected, got=got, remedy=remedy)

    @property
    def linear(self) -> bool:
        """Whether the terms are linear in the variables."""
        return self.degree <= 1 and not self.knots and not self.friction

    def nested(self) -> list[Library]:
        """Libraries of which each contains the one before; the last is this one."""
        smaller = [Library(degree, (), False) for degree in range(self.degree + 1)]
        smaller.append(replace(self, sticking=False))
        return [*(each for each in smaller if each != self), self]

    def terms(
        self,
        variables: Sequence[str],
        states: int,
        signs: Sequence[int] = (),
        zeros: Sequence[float] = (),
    ) -> list[Term]:
        """The terms of an equation with such variables, of which the first `states` are states.

        `signs` are those of `allowed`, by default all free. `zeros` are the scaled variables where
        these are 0 in their own units, by default in the middle.
        """
        places = range(len(variables))
        degree = self.degree
        # Number of monomials of an equation above which their degree is lowered.
        while degree > 1 and comb(len(variables) + degree, degree) > 200:
            degree -= 1
        found = [
            Term(
                _product(variables, chosen),
                partial(_monomial, chosen=chosen),
                [_direction(chosen, i) for i in places],
            )
            for order in range(degree + 1)
            for chosen in combinations_with_replacement(places, order)
        ]
        for i, name in enumerate(variables):
            only = [int(i == place) for place in places]
            for sign, knot in product((1, -1), self.knots):
                shifted = f"{'-' if sign < 0 else ''}{name}{f' - {knot:g}' if knot else ''}"
                hinge = partial(_hinge, i=i, sign=sign, knot=knot)
                shift = Parameter(f"shift of max(0, {shifted})", "1", *SHIFTS, 0.0)
                directions, inner = [sign * each for each in only], (shift,) if knot else ()
                found.append(Term(f"max(0, {shifted})", hinge, directions, inner))
            if self.friction and i < states:
                zero = zeros[i] if zeros else 0.0
                width = Parameter(f"log width of sign({name})", "1", *WIDTHS, 0.0)
                coulomb = partial(_sign, i=i, zero=zero)
                found.append(Term(f"sign({name})", coulomb, only, (width,)))
                quadratic = partial(_quadratic, i=i, zero=zero)
                found.append(Term(f"{name} |{name}|", quadratic, only))
        return list(allowed(found, signs or [0] * len(variables)))

    def dead_zone(self, rate: str, count: int) -> list[Term]:
        """Dry friction of a state with such a time derivative, the variable after `count` others.

        It is the twin's own derivative, which friction takes away where it is small: a valve moves
        where the force on it exceeds its friction. A weight of 1 leaves nothing of it. Where the
        velocity is a state itself, friction is a sign of that.
        """
        width = Parameter(f"log width of the dead zone of {rate}", "1", *WIDTHS, 0.0)
        term = Term(f"dead zone of {rate}", _dead_zone, [None] * count, (width,), 0.0, 1.0)
        return [term] if self.friction and self.sticking else []


def _monomial(v: Sequence[Any], chosen: Sequence[int]) -> Any:
    return prod(v[i] for i in chosen)


def _direction(chosen: Sequence[int], i: int) -> int | None:
    """See `Term.directions`: that of a monomial."""
    if i not in chosen:
        return 0
    others = (chosen.count(each) % 2 == 0 for each in chosen if each != i)
    return 1 if chosen.count(i) % 2 and all(others) else None


def _hinge(v: Sequence[Any], shift: Any = 0.0, *, i: int, sign: int, knot: float) -> Any:
    # Usual distance of a hinge from its knot, in half ranges of its variable: half of that between
    # two knots.
    return torch.relu(sign * v[i] - knot - 0.2 * shift)


def _sign(v: Sequence[Any], width: Any, i: int, zero: float) -> Any:
    return torch.tanh((v[i] - zero) / (WIDTH * torch.exp(torch.as_tensor(width).double())))


def _dead_zone(v: Sequence[Any], width: Any) -> Any:
    size = WIDTH * torch.exp(torch.as_tensor(width).double())
    return size + torch.relu(v[-1] - size) - torch.relu(v[-1] + size)


def _quadratic(v: Sequence[Any], i: int, zero: float) -> Any:
    return (v[i] - zero) * torch.abs(v[i] - zero)


def _product(variables: Sequence[str], chosen: Sequence[int]) -> str:
    powers = [(name, chosen.count(i)) for i, name in enumerate(variables) if i in chosen]
    return " ".join(name if power == 1 else f"{name}^{power}" for name, power in powers) or "1"
