"""`Diagnoser`: the interface of all diagnosers, and `load_diagnoser` for those that were saved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from numpy.typing import NDArray

from retwin.catalog import DIAGNOSERS, resolve
from retwin.data.trajectories import Trajectories
from retwin.nets.training import Fit, Training
from retwin.progress import Progress
from retwin.serialisation.models import kind_of, refusing


@runtime_checkable
class Diagnoser(Protocol):
    """Classifies trajectories: it gives the probability of each class."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names, in the order of the probabilities."""

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Class probabilities; labels of the trajectories have no effect.

        Parameters
        ----------
        trajectories : Trajectories
            n trajectories with the output channels and the sample rate of the training set.

        Returns
        -------
        NDArray
            Probabilities (n, classes) that sum to 1 in each row.

        Raises
        ------
        InputError
            If the output channels or the sample rate differ from those of the training set.

        """


class FittedDiagnoser(Diagnoser, Protocol):
    """A diagnoser that can be saved."""

    def save(self, folder: str | Path) -> None:
        """Write a folder that `load_diagnoser` reads."""


class TrainedDiagnoser(FittedDiagnoser, Protocol):
    """A diagnoser that `fit_diagnoser` returns."""

    @property
    def fitted(self) -> Fit | None:
        """How its training ended."""


@dataclass(frozen=True, eq=False)
class TrainingTask:
    """What a diagnoser is trained on, and how; see the arguments of `fit_diagnoser`."""

    trajectories: Trajectories
    target: Trajectories | None
    seed: int
    classes: Sequence[str] | None
    rate: float | None
    training: Training | None
    progress: Progress | None


@runtime_checkable
class Method(Protocol):
    """A config object that trains a diagnoser of its own kind; a plain network needs none.

    Attributes
    ----------
    adapts : bool
        Whether it learns from real trajectories besides, the `target`.

    """

    adapts: ClassVar[bool]

    def fit(self, task: TrainingTask, /) -> TrainedDiagnoser:
        """Train a diagnoser."""


def load_diagnoser(folder: str | Path) -> FittedDiagnoser:
    """Read a diagnoser of any kind that the catalog lists.

    Parameters
    ----------
    folder : str or Path
        What the diagnoser's `save` wrote.

    Returns
    -------
    FittedDiagnoser
        An object of the class that `retwin.catalog.DIAGNOSERS` names for the folder's kind.

    Raises
    ------
    InputError
        If the folder holds no diagnoser, or a damaged one.

    """
    # A folder of no known kind is refused by this class, with a message that states what it lacks.
    entry = DIAGNOSERS.get(kind_of(folder), DIAGNOSERS["diagnoser"])
    with refusing(folder, expected="a diagnoser"):
        found: FittedDiagnoser = resolve(entry.target).load(folder)
    return found
