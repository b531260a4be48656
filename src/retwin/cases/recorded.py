"""`RecordedCase`: what files of a system's trajectories need of its case, without any model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.twin import Twin
from retwin.twins.wrappers.wrapper import OfTwin


@dataclass(frozen=True)
class RecordedCase(OfTwin):
    """A `data.io.DataCase` of a built-in case, which is imported without torch.

    Parameters
    ----------
    classes : tuple of str
        The class names in their fixed order.
    twin : Twin
        A twin with the channels and the sample rate of the data.
    recover : callable or None
        Completes trajectories without commands, see `Case`.

    """

    classes: tuple[str, ...]
    twin: Twin
    recover: Callable[[Trajectories, Progress | None], Trajectories] | None = None

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """`trajectories` with commands, recovered if the file has none and the case can do so."""
        if trajectories.commands.shape[2] or self.recover is None:
            return trajectories
        return self.recover(trajectories, progress)
