"""`Case`: what one system binds together, so that the rest of retwin need not know the system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from retwin.data.trajectories import Channels, Trajectories
from retwin.nets.networks import MLP, Network
from retwin.nets.training import Training
from retwin.progress import Progress
from retwin.twins.faults import Fault, Stuck
from retwin.twins.parametric import ParametricTwin
from retwin.twins.samplers import CommandSampler
from retwin.twins.twin import Twin
from retwin.update.corrections import Correction
from retwin.update.residual import Density, Mixture, SequenceMixture

__all__ = ["Body", "Case"]


class Body(Protocol):
    """What can be drawn of a system: a chain of points in space, moved by joints.

    Only outputs are measured. The pose behind them is inferred, for pictures and for nothing else.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, as in `model`."""
        ...

    @property
    def model(self) -> Path | None:
        """An MJCF file that has these joints, z upwards; None when the chain is all there is."""
        ...

    def poses(self, trajectories: Trajectories) -> tuple[NDArray, NDArray]:
        """Joint positions (n, T, joints) in rad or m, nominal and observed.

        The observed ones are the nearest to the nominal ones that explain the outputs.
        """
        ...

    def skeleton(self, joints: NDArray) -> NDArray:
        """Points (..., k, 3) in m along the chain, from its root to its tip."""
        ...


@dataclass(frozen=True)
class Case:
    """One system.

    Attributes
    ----------
    name, title: for the command line, and for people.
    faults: class name to fault, `None` for healthy, in the fixed order of the classes.
    twin: the simulator that is to be updated.
    emulator: a stand-in for the real system, for trying things out; its data are "emulated".
    sampler: draws commands.
    correction: the shape that the gap may take, by default.
    output_correction: the same told at the outputs alone, as in the paper, for comparison.
    sensor_rate: samples per second that the measuring chain really takes.
    recover: fills in commands that a file does not hold; None when files hold them.
    parametric: the twin with what is not known of it as parameters, for updating those instead;
        None when the case cannot say.
    encoder_noise: puts reading noise of so many command units on frozen actuators (trajectories,
        units, seed); None when the case cannot tell what that does to its outputs.
    published: the figures of a paper to show beside ours: source to metric to text.
    body: what can be drawn of the system; None when there is nothing to draw.
    network, training: of the surrogate; None trains it as suits the network.
    per_class: trajectories of each class that a surrogate or a diagnoser learns from, by default.
    density: the law of the gap, of one value per sample where the correction has that resolution.
    records: splits a file into what calibrates and what tests, where a benchmark says so; None
        when files hold one set.

    """

    name: str
    title: str
    faults: Mapping[str, Fault | None]
    twin: Twin
    emulator: Twin | None
    sampler: CommandSampler
    correction: Correction
    output_correction: Correction
    sensor_rate: float
    recover: Callable[[Trajectories, Progress | None], Trajectories] | None = None
    parametric: ParametricTwin | None = None
    encoder_noise: Callable[[Trajectories, float, int], Trajectories] | None = None
    published: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    body: Body | None = None
    network: Network = MLP()  # noqa: RUF009 - frozen
    training: Training | None = None
    per_class: int = 400
    density: Density | SequenceMixture = Mixture()  # noqa: RUF009 - frozen
    records: Callable[[Path], tuple[Trajectories, Trajectories]] | None = None

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names in their fixed order."""
        return tuple(self.faults)

    @property
    def diagnosed(self) -> bool:
        """Whether there is more than one class to tell apart."""
        return len(self.faults) > 1

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.twin.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.twin.outputs

    @property
    def rate(self) -> float:
        """Samples per second of the data."""
        return self.twin.rate

    def with_random_onset(self) -> Case:
        """The same case with stuck actuators that freeze anywhere in the first four fifths."""
        onset = (0, 4 * self.sampler.steps // 5)
        faults = {
            name: replace(fault, onset=onset) if isinstance(fault, Stuck) else fault
            for name, fault in self.faults.items()
        }
        # What noise does to a frozen joint is known for the published onset only.
        return replace(self, faults=faults, encoder_noise=None)

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """`trajectories` with commands, recovered if the file has none and the case knows how."""
        if trajectories.commands.shape[2] or self.recover is None:
            return trajectories
        return self.recover(trajectories, progress)
