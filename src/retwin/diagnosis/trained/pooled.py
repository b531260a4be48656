"""`PooledDiagnoser`: several diagnosers whose probabilities are combined into one distribution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.diagnoser import Diagnoser

FLOOR = 1e-3
"""Lower bound of a member's probability, so that no member excludes a class alone.

It was set before any pool was scored: no member was tested on the thousands of real trajectories
that would justify a smaller probability.
"""


class PooledDiagnoser:
    """The logarithmic pool of diagnosers: the normalised geometric mean of their probabilities.

    Parameters
    ----------
    members : sequence of Diagnoser
        Fitted diagnosers of the same classes, each in an order of its own; the pool takes the
        order of the first one.

    Attributes
    ----------
    classes : tuple of str
        Class names, in the order of the probabilities.

    Raises
    ------
    InputError
        If there is no member, or if the members have different classes.

    Notes
    -----
    For k members, p(c) is proportional to prod_i max(p_i(c), FLOOR)^(1/k). The weights are equal:
    choosing others would need labelled faults of the real machine. They sum to 1, because members
    that use the same outputs are not independent: where all agree, the pool agrees with them.

    References
    ----------
    Genest and Zidek, "Combining probability distributions", Statistical Science 1, 114 (1986),
    section 3.

    """

    def __init__(self, members: Sequence[Diagnoser]) -> None:
        self.members = tuple(members)
        alike = len({tuple(sorted(member.classes)) for member in self.members}) == 1
        expected = "one diagnoser or more, all of the same classes"
        got = [member.classes for member in self.members]
        remedy = "fit all of them with the classes of one case"
        require(alike, "members", expected=expected, got=got, remedy=remedy)
        self.classes = self.members[0].classes

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        probabilities = []
        for member in self.members:
            order = [member.classes.index(name) for name in self.classes]
            probabilities.append(member.predict_proba(trajectories)[:, order])
        return pool_probabilities(probabilities)


def pool_probabilities(probabilities: Sequence[NDArray]) -> NDArray:
    """The logarithmic pool of probabilities (..., classes), see `PooledDiagnoser`."""
    logs = np.mean([np.log(np.maximum(each, FLOOR)) for each in probabilities], axis=0)
    pooled: NDArray = np.exp(logs)
    return pooled / pooled.sum(axis=-1, keepdims=True)
