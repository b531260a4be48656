"""`Case`: the twin, faults, commands and settings of one system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from retwin.cases.named_signals import Columns
from retwin.cases.recorded import RecordedCase
from retwin.checks import agree, nothing, one_of, require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.nets.networks import MLP, Network
from retwin.nets.training import Training
from retwin.progress import Progress
from retwin.twins.commands.samplers import CommandSampler
from retwin.twins.faults.actuator_faults import Fault, Stuck
from retwin.twins.faults.system_faults import TimedFault
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.wrapper import OfTwin
from retwin.update.corrections import Correction
from retwin.update.dynamics import Dynamics, state_names
from retwin.update.residual import Density, Mixture, SequenceMixture
from retwin.update.state_surrogate import StateSurrogate


class Body(Protocol):
    """A chain of points in space, moved by joints, by which a system is drawn.

    The poses are inferred from the outputs, for pictures only.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, as in `model`."""

    @property
    def model(self) -> Path | None:
        """An MJCF file that has these joints, z upwards; None if only the chain is drawn."""

    def poses(self, trajectories: Trajectories) -> tuple[NDArray, NDArray]:
        """Joint positions (n, T, joints) in rad or m, nominal and observed.

        The observed pose is the one nearest to the nominal pose that gives the observed outputs.
        """

    def skeleton(self, joints: NDArray) -> NDArray:
        """Points (..., k, 3) in m along the chain, from its root to its tip."""


@dataclass(frozen=True, kw_only=True)
class Case(OfTwin):
    """One system: all that the rest of retwin must know of it.

    Studies, the command line and reports take a case and hold nothing about a particular system.
    Built-in cases are in `catalog.CASES`; `read_case` makes one from a case.toml.

    Attributes
    ----------
    name : str
        Its name on the command line.
    title : str
        Its name on pages.
    faults : mapping of str to Fault or None
        The fault of each class, None for the healthy one, which is the only one by default. The
        order is that of the classes in all results.
    twin : Twin
        The simulator to be updated; its channels and sample rate are those of the case.
    emulator : Twin or None
        A stand-in for the real system, whose outputs count as emulated measurements.
    sampler : CommandSampler
        The distribution of commands, for training data of surrogates and diagnosers.
    correction : Correction
        The default form of the discrepancy.
    output_correction : Correction
        A form of the discrepancy in the outputs alone, as in the paper, for comparison.
    sensor_rate : float
        The rate in Hz at which the sensor delivers samples, at most that of the data.
    recover : callable or None
        Completes trajectories without commands (trajectories, progress); None if files hold the
        commands.
    parametric : ParametricTwin or None
        The twin with its uncertain parameters free, for identification; None if there are none.
    encoder_noise : callable or None
        Adds the encoder noise of the actuators to all trajectories alike (trajectories, amplitude
        in command units, seed); None if its effect on the outputs is not known.
    published : mapping of str to mapping of str to str
        Figures of a paper, shown beside the results: source to metric to text.
    body : Body or None
        How the system is drawn; None if it is not.
    network : Network
        The network of the surrogate.
    training : Training or None
        How the surrogate is trained; None for the default of the network.
    per_class : int
        The default number of trajectories per class in training sets of surrogates and diagnosers.
    density : Density or SequenceMixture
        The conditional distribution of the discrepancy z: per segment, or per sample if the
        correction has one z per sample.
    records : callable or None
        Splits a file into the calibration set and the test set of a benchmark; None if a file holds
        one set.
    logs : Columns
        How logs name the channels of the twin, where they have other names.
    dynamics : Dynamics
        The form of a discrepancy inside the state equations.
    state_surrogate : StateSurrogate
        How state equations are learned for it from simulations, of a twin that is no `StateTwin`.
    causes : mapping of str to Fault
        Further causes of alarms of a monitor, beside the faults. They are no classes.

    Raises
    ------
    InputError
        The sampler has another rate than the twin, or an actuator would be stuck from after the end
        of a trajectory only.

    """

    name: str
    title: str
    faults: Mapping[str, Fault | None] = field(default_factory=lambda: {HEALTHY: None})
    twin: Twin
    emulator: Twin | None = None
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
    logs: Columns = Columns()  # noqa: RUF009 - frozen
    dynamics: Dynamics = Dynamics()  # noqa: RUF009 - frozen
    state_surrogate: StateSurrogate = StateSurrogate()  # noqa: RUF009 - frozen
    causes: Mapping[str, Fault] = field(default_factory=dict)

    def __post_init__(self) -> None:
        whose, remedy = "that of the twin", "give both the same rate"
        agree("sampler", self.sampler, self, whose, names=("rate",), remedy=remedy)
        require(
            all(each.strip() for each in (self.name, *self.faults, *self.causes)),
            "name",
            expected="a name for the case, and for each of its faults and causes",
            got="an empty one",
            remedy="write one by which you will know it",
        )
        require(
            self.faults.get(HEALTHY) is None,
            f"faults.{HEALTHY}",
            expected=f"no fault: {HEALTHY!r} is the class without one",
            got=self.faults.get(HEALTHY),
            remedy="give the fault another name",
        )
        for name in self.dynamics.states:
            one_of("dynamics.states", name, state_names(self.twin) or (name,))
        twice = [name for name in self.causes if name in self.faults]
        remedy = "the faults are causes of alarms already: leave them out"
        nothing("causes", twice, "names that no fault has", remedy=remedy)
        for fault in self.faults.values():
            if isinstance(fault, Stuck | TimedFault):
                fault.onset_range(self.sampler.steps, self.rate)

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names in their fixed order."""
        return tuple(self.faults)

    @property
    def diagnosed(self) -> bool:
        """Whether there is more than one class, so that a diagnosis makes sense."""
        return len(self.faults) > 1

    @property
    def alarm_causes(self) -> dict[str, Fault | None]:
        """The faults and the further causes of alarms, by their names."""
        return {**self.faults, **self.causes}

    def with_random_onset(self) -> Case:
        """The same case with stuck actuators whose onset is uniform in the first 4/5 of a run."""
        onset = (0.0, 0.8 * self.sampler.steps / self.rate)
        faults = {
            name: replace(fault, onset=onset) if isinstance(fault, Stuck) else fault
            for name, fault in self.faults.items()
        }
        # The effect of encoder noise on a frozen joint is known for the published onset only.
        return replace(self, faults=faults, encoder_noise=None)

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """`trajectories` with commands, recovered if the file has none and the case can do so."""
        recorded = RecordedCase(self.classes, self.twin, self.recover)
        return recorded.complete(trajectories, progress=progress)
