"""Models of other machines of the kind as the prior of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from retwin.checks import agree, given, instance, require
from retwin.twins.twin import Twin
from retwin.update.corrections import CommandSpace, Correction, before_sensor
from retwin.update.corrections.commands.machines import OtherMachines
from retwin.update.residual.loading import load_residual
from retwin.update.residual.residual import Residual


class Machine(Protocol):
    """A model of a machine that has a residual model, such as a `CorrectedTwin`."""

    @property
    def residual(self) -> Residual[Any]:
        """What it has learned."""


Prior = Residual[Any] | Machine | str | Path
Priors = Prior | Sequence[Prior]


def other_machines(
    prior: Priors | None, correction: Correction, twin: Twin
) -> OtherMachines | None:
    """What models of other machines have learned of a kind; None without any.

    Raises InputError for a correction that has no such hyperparameters, and for a model of another
    correction or of other channels.
    """
    if prior is None:
        return None
    several = isinstance(prior, Sequence) and not isinstance(prior, str)
    models: Sequence[Prior] = prior if several else [prior]  # type: ignore[assignment, list-item]
    require(
        len(models), "prior", expected="models of other machines", got="none", remedy="name one"
    )
    operator = before_sensor(correction)
    expected = "a correction with CommandSpace, alone or before a SampledSensor"
    got = f"{type(operator).__name__}, which learns nothing that machines have in common"
    remedy = "leave the prior out, or correct in command space"
    require(isinstance(operator, CommandSpace), "prior", expected=expected, got=got, remedy=remedy)
    shown = []
    for each in models:
        model, name = _residual(each)
        alike = type(before_sensor(model.correction)) is type(operator)
        expected = "models with CommandSpace, as this one"
        got = f"{type(before_sensor(model.correction)).__name__} in {name}"
        require(alike, "prior", expected=expected, got=got, remedy="leave it out")
        remedy = f"leave {name} out: it is no machine of this kind"
        agree("prior", model, twin, "those of the twin", names=("inputs", "outputs"), remedy=remedy)
        expected, got = "models that state what their machine has shown", f"none in {name}"
        remedy = "fit it again with this version"
        shown.append(given("prior", model.learned, expected, got=got, remedy=remedy))
    return OtherMachines.of(shown)


def _residual(prior: Prior) -> tuple[Residual[Any], str]:
    """The residual model of a prior, and what messages call it."""
    if isinstance(prior, str | Path):
        inside = Path(prior) / "residual"
        return load_residual(inside if inside.is_dir() else prior), str(prior)
    model, name = getattr(prior, "residual", prior), type(prior).__name__
    remedy = "give a residual model, a corrected twin, or the folder of one"
    return instance("prior", model, Residual, remedy=remedy), name  # type: ignore[type-abstract]
