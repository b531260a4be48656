"""`StateTwin`: a twin that is a state-space model, from its equations alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import at_least, finite, nothing, one_of, require, whole
from retwin.data.trajectories import Channels
from retwin.times import sample_rate
from retwin.twins.equations.interpolation import INTERPOLATIONS
from retwin.twins.equations.saved_equations import equations_from, equations_of
from retwin.twins.equations.state import State, check_delays
from retwin.twins.equations.step_error import warn_of_coarse_steps
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import parameter_changes
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, checked_commands
from retwin.twins.wrappers.parameter_values import AdjustableTwin, values_per_simulation
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

if TYPE_CHECKING:  # describing a twin needs no torch, which takes seconds to import
    from torch import Tensor

    from retwin.twins.compiled.model import Model
    from retwin.twins.compiled.steps import Steps


SAMPLES_PER_CHUNK = 2**20
"""Number of samples, of all trajectories together, that are simulated at once: some 100 MB."""
MAX_SUBSTEPS = 10_000
"""Sub-steps of a sample, above which equations are too stiff for an explicit method."""
FINER = 16
"""How many times more sub-steps are tried before a simulation that is not finite is given up."""


@dataclass(frozen=True)
class StateTwin(AdjustableTwin):
    """A twin whose states follow equations that are written with torch.

    `derivative` or `step`, and `output`, are functions of named tuples of scalars: the states x,
    the commands u and the parameters p; a function of x and u alone may leave p out. They are
    traced once. What they compute is then compiled for simulations, which are thousands of times
    faster than the same in torch, and evaluated in torch where a gradient is needed; both agree to
    1e-9. Branches are `torch.where`.

    Parameters
    ----------
    states : sequence of State
        The states, one at least.
    output : callable
        The outputs at a sample, in the order of `outputs`: a scalar, or several.
    inputs, outputs : Channels
        Channels of the commands and the outputs.
    rate : float
        Sample rate in Hz, above 0.
    derivative : callable, optional
        The time derivatives of the states, per second, in their order. They are integrated by the
        classical Runge-Kutta method of fourth order.
    step : callable, optional
        The states one sample later, in place of `derivative`.
    parameters : sequence of Parameter
        Numbers of the equations, with their units, bounds, and starts, which are used by default.
    substeps : int, default 1
        Steps of the integration per sample, up to 10 000.
    interpolation : {"hold", "linear", "spline"}, optional
        The commands between samples, see `INTERPOLATIONS`; `step` has no such time. By default
        they are held, and `fit_dynamics` chooses by the calibration record.
    limits : Limits, optional
        Range of the commands.
    delays : mapping of str to str, optional
        Names of commands that act after a dead time, each with the name of the parameter, in s,
        that is its dead time: a parameter as any other, but for faults. Before the first sample a
        command is the first one; a fraction of a sample is interpolated linearly, so that of a
        held command the mean over each sample acts.
    learned : bool, default False
        Whether the equations were learned from simulations, so that the coordinates of their
        states are arbitrary; `fit_dynamics` then leaves to the parameters all that they explain.

    Raises
    ------
    InputError
        Not one of `derivative` and `step`, names twice, settings that `step` cannot have. When it
        is first simulated: equations that cannot be traced.

    Warns
    -----
    StepWarning
        Twice the sub-steps change an output of the first trajectory by more than 1 % of its
        standard deviation.
    UserWarning
        There is no C compiler.

    Notes
    -----
    A stuck actuator is a held command. A trajectory whose states are not finite is named in a
    `SimulationError`.

    """

    states: Sequence[State]
    output: Callable[..., Any]
    inputs: Channels
    outputs: Channels
    rate: float
    _: KW_ONLY
    derivative: Callable[..., Any] | None = None
    step: Callable[..., Any] | None = None
    parameters: Sequence[Parameter] = ()
    substeps: int = 1
    interpolation: str | None = None
    limits: Limits | None = None
    delays: Mapping[str, str] = field(default_factory=dict)
    learned: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", tuple(self.states))
        object.__setattr__(self, "delays", dict(self.delays))
        object.__setattr__(self, "parameters", tuple(self.parameters))
        at_least("states", self.states, 1, "state", remedy="a system without memory is a function")
        require(
            (self.derivative is None) != (self.step is None),
            "derivative",
            expected="either derivative or step",
            got="both" if self.step else "neither",
            remedy="give the time derivatives of the states, or the states one sample later",
        )
        twice = sorted({name for name in self.names if list(self.names).count(name) > 1})
        nothing(
            "parameters",
            [f"{name} twice" for name in twice],
            "different names of parameters and states",
            remedy="the start of a state is the parameter start_NAME; rename the other",
        )
        sample_rate("rate", self.rate)
        whole("substeps", self.substeps, at_least=1, at_most=MAX_SUBSTEPS)
        if self.interpolation is not None:
            one_of("interpolation", self.interpolation, INTERPOLATIONS)
        fits = self.step is None or (self.substeps == 1 and self.interpolation in {None, "hold"})
        expected = "substeps=1 and interpolation='hold'"
        got = f"substeps={self.substeps}, interpolation={self.interpolation!r}"
        remedy = "leave both out: a step covers one sample period"
        require(fits, "step", expected=expected, got=got, remedy=remedy)
        check_delays(self.delays, self.inputs.names, self.parameters)

    def __reduce__(self) -> tuple[Any, ...]:
        """The equations as operations on numbers, since functions of any kind have these."""
        return equations_from, (StateTwin, equations_of(self))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, and then of the starts of the states."""
        starts = (f"start_{state.name}" for state in self.states)
        return (*(each.name for each in self.parameters), *starts)

    @property
    def deterministic(self) -> bool:
        """True: the outputs depend on no seed."""
        return True

    @property
    def fingerprint(self) -> str:
        """The equations as C99, which identify the twin where the names of functions do not."""
        return self.stepped.source

    @property
    def delay_places(self) -> tuple[tuple[int, int], ...]:
        """Indices of the commands with a dead time, and of the parameters that are these."""
        places = self.inputs.names.index, self.names.index
        return tuple((places[0](u), places[1](name)) for u, name in self.delays.items())

    @cached_property
    def stepped(self) -> Model:
        """The traced equations after the dead times of the commands; see `Model.delayed`."""
        return self.model.delayed(self.delay_places) if self.delays else self.model

    @cached_property
    def model(self) -> Model:
        """The traced equations.

        Raises
        ------
        InputError
            They cannot be traced, or return too few results.

        """
        from retwin.twins.compiled.model import trace_model, with_parameters

        function = self.step or self.derivative
        states, parameters = ([each.name for each in own] for own in (self.states, self.parameters))
        return trace_model(
            with_parameters(function),
            with_parameters(self.output),
            (states, self.inputs.names, parameters),
            len(self.outputs),
            discrete=self.step is not None,
        )

    @property
    def shiftable(self) -> tuple[str, ...]:
        """Names of the parameters that can change during a simulation: not the dead times."""
        fixed = set(self.delays.values())
        return tuple(each.name for each in self.parameters if each.name not in fixed)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters, and the unknown starts of the states."""
        return (*self.parameters, *(each for state in self.states for each in state.unknown()))

    def parametric(self) -> ParametricTwin:
        """The twin with its parameters and unknown starts free, for identification.

        Raises
        ------
        InputError
            There is none.

        """
        return ParametricTwin(self, self.free)

    @property
    def _adjustable(self) -> tuple[str, ...]:
        return self.names

    def _count(self, steps: int) -> int:
        return max(1, SAMPLES_PER_CHUNK // steps)

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs."""
        count, steps, _ = chunk.commands.shape
        own = self.values(chunk.parameters, count)
        nominal = self._outputs(chunk, chunk.commands, own)
        if chunk.index.start == 0 and 0 not in chunk.failed:
            self.check_accuracy(chunk.commands[:1], own[:1], nominal[:1])
        held, changes = chunk.held_commands, self.changes(chunk.faults, steps)
        faulty = (held != chunk.commands).any(axis=(1, 2)) | changes.any(axis=(1, 2))
        observed = nominal.copy()
        if faulty.any():
            observed[faulty] = self._outputs(chunk, held, own, changes, faulty)
        return nominal, observed

    def hidden(
        self, commands: NDArray, parameters: Mapping[str, ArrayLike] | None = None
    ) -> NDArray:
        """The states (n, T, d_x) at every sample, for commands (n, T, d_u) and `parameters`.

        States of a simulation that diverges are not finite.
        """
        commands = checked_commands(commands, self.inputs)
        values = self.values(parameters, len(commands))
        return self.steps().run(commands, values)[1]

    def sensitivities(
        self, commands: NDArray, parameters: Mapping[str, ArrayLike] | None = None
    ) -> tuple[NDArray, NDArray]:
        """Outputs and their derivatives by all parameters, by forward sensitivities.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Commands, as for `simulate`.
        parameters : mapping of str to array_like, optional
            See `simulate`.

        Returns
        -------
        outputs : ndarray, shape (n, T, d_y)
            Nominal outputs, not finite where the simulation diverges.
        derivatives : ndarray, shape (n, T, d_y, k)
            Their derivatives by the k parameters `names`, those of the simulation itself, not of
            the exact solution of its equations.

        """
        commands = checked_commands(commands, self.inputs)
        values = self.values(parameters, len(commands))
        return self.steps().sensitivities(commands, values)

    def __call__(
        self, commands: Tensor, parameters: Mapping[str, Tensor | float] | None = None
    ) -> Tensor:
        """Nominal outputs in torch, with gradient by commands and parameters.

        Parameters
        ----------
        commands : Tensor, shape (n, T, d_u)
            Commands within the limits, which are not checked.
        parameters : mapping of str to Tensor or float, optional
            Some of `names`, each of shape () or (n,).

        Returns
        -------
        Tensor, shape (n, T, d_y)
            The outputs, computed in double precision, in that of the commands.

        """
        import torch

        defaults = dict(zip(self.names, self.values(None, 1)[0], strict=True))
        unknown = sorted(set(parameters or {}) - set(defaults))
        nothing(
            "parameters", unknown, f"some of {', '.join(self.names)}", remedy="check the spelling"
        )
        like = commands.new_zeros(len(commands), dtype=torch.float64)
        given = (defaults | dict(parameters or {})).values()
        theta = torch.stack([torch.as_tensor(each).to(like) + like for each in given], 1)
        return self.steps().in_torch(commands.to(like), theta)[0].to(commands)

    def values(self, parameters: Mapping[str, ArrayLike] | None, count: int) -> NDArray:
        """The values (count, k) of all parameters `names`."""
        starts = [
            *(each.start for each in self.parameters),
            *(each.initial for each in self.states),
        ]
        own = values_per_simulation(parameters, count, allowed=self.names)
        columns = zip(self.names, starts, strict=True)
        made = np.stack([own.get(name, np.full(count, start)) for name, start in columns], 1)
        for _, place in self.delay_places:
            finite(self.names[place], float(made[:, place].min(initial=0.0)), at_least=0.0)
        return made

    def changes(self, faults: Sequence[Fault | None], steps: int) -> NDArray:
        """What faults, one per simulation, add to the parameters at each sample: (n, T, q)."""
        names = self.names[: len(self.parameters)]
        return parameter_changes(faults, names, steps, self.rate)

    def steps(self, substeps: int | None = None) -> Steps:
        """The simulation from sample to sample, with other sub-steps if these are given.

        It takes the values (n, k) of all parameters `names`, and checks nothing.
        """
        from retwin.twins.compiled.steps import Steps

        interpolation = self.interpolation or INTERPOLATIONS[0]
        count = substeps or self.substeps
        return Steps(self.stepped, 1 / self.rate, count, interpolation, self.delay_places)

    def _outputs(
        self,
        chunk: Chunk,
        commands: NDArray,
        values: NDArray,
        changes: NDArray | None = None,
        rows: NDArray | None = None,
    ) -> NDArray:
        """Outputs of a chunk's rows; those that are not finite are entered as failed."""
        index = np.arange(len(commands)) if rows is None else np.flatnonzero(rows)

        def simulated(of: NDArray, substeps: int) -> tuple[NDArray, NDArray]:
            own = None if changes is None else changes[of]
            return self.steps(substeps).run(commands[of], values[of], changes=own)

        outputs, states = simulated(index, self.substeps)
        finite = np.isfinite(states).all(axis=2) & np.isfinite(outputs).all(axis=2)
        for place in np.flatnonzero(~finite.all(axis=1)):
            finer = FINER * self.substeps
            remedy = (
                "check the parameters and the start, or the range of the equations: low and high "
            )
            remedy += "of a State do not clamp it"
            again = simulated(index[place : place + 1], finer)
            if self.derivative is not None and all(np.isfinite(each).all() for each in again):
                remedy = f"it is finite with {finer}: give more substeps"
            time = np.argmin(finite[place]) / self.rate
            reason = f"not finite from {time:g} s on with substeps={self.substeps}; {remedy}"
            chunk.failed[int(index[place])] = reason
            outputs[place] = 0.0
        return outputs

    def check_accuracy(self, commands: NDArray, values: NDArray, outputs: NDArray) -> None:
        """Warn where twice the sub-steps give other outputs than these (1, T, d_y).

        Parameters
        ----------
        commands, values : ndarray, shapes (1, T, d_u) and (1, k)
            Those of the simulation; the values are of all parameters `names`.
        outputs : ndarray, shape (1, T, d_y)
            What it gave.

        Warns
        -----
        StepWarning
            See the class.

        """
        if self.step is None:
            finer, _ = self.steps(2 * self.substeps).run(commands, values)
            warn_of_coarse_steps(outputs[0], finer[0], self.outputs, self.substeps)
