"""What every diagnoser offers: trajectories in, class probabilities out."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories

__all__ = ["Diagnoser"]


@runtime_checkable
class Diagnoser(Protocol):
    """Tells which class a trajectory belongs to."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names, in the order of the probabilities."""
        ...

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes) that sum to one; labels are not looked at.

        Raises
        ------
        InputError: other output channels or another sample rate than it was trained on.

        """
        ...
