"""`ExactSurrogate`: a twin itself in place of a surrogate, without a network's error."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin import catalog
from retwin.checks import given, require
from retwin.data.trajectories import Trajectories
from retwin.serialisation.models import kind_of, read_about, refusing, save_model
from retwin.twins.equations.saved_equations import equations_from, equations_of
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import Twin, check_channels
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.wrapper import OfTwin
from retwin.update.dynamics.estimation import estimate_starts
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_names, state_twin_of, unknowns_of
from retwin.update.surrogate import Surrogate

KIND = "twin"
"""Kind of a twin that was saved in place of a surrogate."""


class ExactSurrogate(OfTwin):
    """A twin with the methods of a surrogate that corrections and residual models use.

    A twin that can be called with a tensor, such as a torch module or a `StateTwin`, is
    differentiated through its call. Of any other twin, and of these where no gradient is needed,
    `CommandSpace` takes finite differences, each of which is a simulation.

    Parameters
    ----------
    twin : Twin
        Its nominal outputs stand for those of a surrogate.
    differences : bool
        Whether a warning on the cost of finite differences is given at the first call.

    """

    twin: Twin
    memoryless = False
    """Whether an output depends on the command of its own sample only: of a twin it is unknown."""

    def __init__(self, twin: Twin, *, differences: bool) -> None:
        self.twin = twin
        self._warns = differences

    def predict(self, commands: NDArray) -> NDArray:
        """The nominal outputs (n, T, d_y), float32, for commands (n, T, d_u)."""
        values = np.asarray(commands, np.float64)
        if isinstance(self.twin, DynamicsTwin):  # whose simulations have noise besides
            return self.twin.simulation.most_probable(values)[0].astype(np.float32)
        return self.twin.simulate(values, seed=0).nominal.astype(np.float32)

    @property
    def unknown_starts(self) -> bool:
        """Whether it has a state whose start is not known, which `started` infers."""
        if isinstance(self.twin, DynamicsTwin):
            return self.twin.unknown_starts
        if not state_names(self.twin):
            return False
        base, _, values = state_twin_of(self.twin)  # type: ignore[arg-type]
        return len(unknowns_of(base, (), values).free) > 0

    def started(self, record: Trajectories) -> ExactSurrogate:
        """The same with the unknown starts of one record; see `DynamicsTwin.started`."""
        if isinstance(self.twin, DynamicsTwin):
            return ExactSurrogate(self.twin.started(record), differences=self._warns)
        check_channels(self.twin, record, "record")
        base, _, values = state_twin_of(self.twin)  # type: ignore[arg-type]
        unknowns = unknowns_of(base, (), values)
        starts, _ = estimate_starts(base, record, unknowns)
        names = [f"start_{base.states[i].name}" for i in unknowns.free]
        own = values | dict(zip(names, starts.tolist(), strict=True))
        return ExactSurrogate(_at_values(base, own), differences=self._warns)

    def fitted_outputs(self, records: Trajectories) -> NDArray:
        """Nominal outputs (n, T, d_y) from the unknown starts that fit each whole record best."""
        own = [records[[i]] for i in range(len(records))]
        starts = (self.started(each) if each.mask.any() else self for each in own)
        pairs = zip(starts, own, strict=True)
        return np.concatenate([each.predict(record.commands) for each, record in pairs])

    def __call__(self, commands: Tensor) -> Tensor:
        """The same for a tensor; with gradient if the twin can be called with one."""
        differentiated = torch.is_grad_enabled() and commands.requires_grad
        if isinstance(self.twin, nn.Module) or (differentiated and callable(self.twin)):
            return self.twin(commands)
        expected = "a twin that is a torch module or a StateTwin, to be differentiated"
        got = type(self.twin).__name__
        remedy = "fit a surrogate to it (fit_surrogate), or leave refinement out"
        require(not differentiated, "surrogate", expected=expected, got=got, remedy=remedy)
        if self._warns:
            self._warns = False
            warnings.warn(
                f"{type(self.twin).__name__} in place of a surrogate: each step of the inference "
                "simulates it once per component of z; a surrogate (fit_surrogate) is faster",
                stacklevel=2,
            )
        return torch.as_tensor(self.predict(commands.numpy()))

    def save(self, folder: str | Path, case: str | None = None) -> None:
        """Write the twin: its equations, or the name of the case whose twin it is, and its values.

        An empty name is that of a twin that `load` must be given. Raises InputError for a twin
        without equations where there can be no name.
        """
        if isinstance(self.twin, DynamicsTwin):
            self.twin.save(folder)
            return
        about: dict[str, Any] = {}
        if state_names(self.twin):
            base, _, values = state_twin_of(self.twin)  # type: ignore[arg-type]
            about["equations"] = equations_of(_at_values(base, values))
        else:
            expected = "a StateTwin, or a surrogate, which can be opened again"
            remedy = "fit a surrogate of it (fit_surrogate)"
            got = type(self.twin).__name__
            about["case"] = given("twin", case, expected, got=got, remedy=remedy)
            if isinstance(self.twin, ParametricTwin):
                about["values"] = dict(zip(self.twin.names, self.twin.values, strict=True))
        save_model(folder, KIND, about, {})

    @classmethod
    def load(cls, folder: str | Path, twin: Twin | None = None) -> ExactSurrogate:
        """Read what `save` wrote; the twin of a case is opened, which may run the user's code.

        `twin` takes the place of the case's. Raises InputError if the folder holds no twin, is
        damaged, its case is not there, or it has none and no twin is given.
        """
        if kind_of(folder) == DynamicsTwin.kind:
            return cls(DynamicsTwin.load(folder), differences=False)
        about = read_about(folder, KIND)
        if "equations" in about:
            with refusing(folder, expected="the equations of a twin"):
                return cls(equations_from(StateTwin, about["equations"]), differences=False)
        values, name = about.get("values"), about["case"]
        if twin is None:
            expected = "the twin of this model, which has neither equations nor a case"
            remedy = "give it in Python, load_twin(folder, twin), or fit a case.toml"
            require(name, "twin", expected=expected, got="none", remedy=remedy)
            system = catalog.resolve(catalog.OPENED_CASE)(name)
            twin = system.twin if values is None else system.parametric
        if values is None:
            return cls(twin, differences=False)
        own = twin if isinstance(twin, ParametricTwin) else None
        expected = "a case that declares the parameters of its twin, as when the model was saved"
        own = given(name, own, expected, got="none", remedy="restore its table [parameters]")
        return cls(own.with_values(values), differences=False)


def load_surrogate(folder: str | Path, twin: Twin | None = None) -> Surrogate:
    """The surrogate in a folder, or the twin that was saved in place of one.

    Raises InputError as `Surrogate.load` and `ExactSurrogate.load` do.
    """
    if kind_of(folder) in (KIND, DynamicsTwin.kind):
        return ExactSurrogate.load(folder, twin)  # type: ignore[return-value]  # it has what is used
    return Surrogate.load(folder)


def _at_values(base: StateTwin, values: Mapping[str, float]) -> StateTwin:
    """The equations of a twin, whose parameters and states start at some values."""
    return replace(
        base,
        parameters=tuple(each.with_start(values[each.name]) for each in base.parameters),
        states=tuple(_start_at(each, values[f"start_{each.name}"]) for each in base.states),
    )


def _start_at(state: State, value: float) -> State:
    if state.low is None or state.high is None:
        return replace(state, start=value)
    return replace(state, start=value, low=min(state.low, value), high=max(state.high, value))


def exact_surrogate(given: Surrogate | Twin, *, differences: bool = True) -> Surrogate:
    """A surrogate as it is, any other twin as an `ExactSurrogate` with that setting.

    Raises
    ------
    InputError
        The object is no twin.

    """
    if hasattr(given, "predict"):
        return given  # type: ignore[return-value]
    expected = "a surrogate, or a twin with inputs, outputs, rate and simulate"
    got = type(given).__name__
    remedy = "fit a surrogate with fit_surrogate"
    require(isinstance(given, Twin), "surrogate", expected=expected, got=got, remedy=remedy)
    return ExactSurrogate(given, differences=differences)  # type: ignore[return-value]
