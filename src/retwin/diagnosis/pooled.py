"""`PooledDiagnoser`: the opinions of several diagnosers as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.diagnoser import Diagnoser
from retwin.errors import InputError

__all__ = ["PooledDiagnoser", "pool_probabilities"]

FLOOR = 1e-3
"""Least probability that a member's opinion is taken for: none may rule a class out alone.

Set before any pool was scored: no member has seen thousands of real trajectories to be so sure.
"""


class PooledDiagnoser:
    """The logarithmic pool of diagnosers: the normalised geometric mean of their probabilities.

    p(c) ~ prod_i max(p_i(c), FLOOR)^(1/k) for k members (Genest and Zidek, Stat. Sci. 1, 114,
    1986, section 3). Weights are equal: to choose others, labelled faults of the real machine would
    be needed, and there are none. They sum to 1: members that look at the same outputs are no
    independent witnesses, and where all agree the pool says what they say.

    Parameters
    ----------
    members: fitted diagnosers of the same classes, each in an order of its own; the pool takes the
        first one's.

    Raises
    ------
    InputError: no member, or members of different classes.

    """

    def __init__(self, members: Sequence[Diagnoser]) -> None:
        self.members = tuple(members)
        known = [sorted(member.classes) for member in self.members]
        if not known or any(each != known[0] for each in known):
            raise InputError(
                "members",
                expected="one diagnoser or more, all of the same classes",
                got=f"{[member.classes for member in self.members]}",
                remedy="fit all of them with the classes of one case",
            )

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names, in the order of the probabilities."""
        return self.members[0].classes

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        opinions = []
        for member in self.members:
            order = [member.classes.index(name) for name in self.classes]
            opinions.append(member.predict_proba(trajectories)[:, order])
        return pool_probabilities(opinions)


def pool_probabilities(opinions: Sequence[NDArray]) -> NDArray:
    """The logarithmic pool of probabilities (..., classes), see `PooledDiagnoser`."""
    logs = np.mean([np.log(np.maximum(each, FLOOR)) for each in opinions], axis=0)
    pooled: NDArray = np.exp(logs)
    return pooled / pooled.sum(axis=-1, keepdims=True)
