"""The variables of an exported twin, and the XML files that describe them."""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined

from retwin._version import __version__
from retwin.data.trajectories import Channels
from retwin.twins.wrappers.parametric import Parameter


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU; its value reference is its place among all.

    Attributes
    ----------
    name, unit, about : str
        Its name, unit ("" for none) and description.
    role : str
        "time", "input", "output", "parameter" (tunable), "fixed" (before the begin), "seed",
        "noise" or "outside".
    start : float
        Its value at the begin, but for outputs.
    limits : (float, float), optional
        Its least and greatest value.

    """

    name: str
    unit: str
    about: str
    role: str
    start: float = 0.0
    limits: tuple[float, float] | None = None


def variables_of(
    inputs: Channels,
    outputs: Channels,
    first: Sequence[float],
    parameters: Sequence[tuple[Parameter, float]],
    starts: Sequence[tuple[str, str, float]],
    *,
    limits: Sequence[tuple[float, float]] | None = None,
    ranged: bool = False,
) -> list[Variable]:
    """All variables in the order of twin.c.

    Parameters
    ----------
    inputs, outputs : Channels
        Commands and outputs.
    first : sequence of float
        Commands before any are given.
    parameters : sequence of (Parameter, float)
        Parameters that may be set, with their values.
    starts : sequence of (str, str, float)
        Name, unit and start value of each state.
    limits : sequence of (float, float), optional
        Least and greatest value of each command.
    ranged : bool
        Whether the FMU compares the commands with those of the training.

    """
    us, ys = (list(zip(each.names, each.units, strict=True)) for each in (inputs, outputs))
    ends: Sequence[tuple[float, float] | None] = [None] * len(us) if limits is None else limits
    made = [Variable("time", "s", "", "time")]
    made += [
        Variable(name, unit, "command", "input", value, each)
        for (name, unit), value, each in zip(us, first, ends, strict=True)
    ]
    made += [Variable(name, unit, "output, drawn if noise is true", "output") for name, unit in ys]
    quantities = (("mean", "its mean"), ("q05", "its 5 % quantile"), ("q95", "its 95 % quantile"))
    for suffix, about in quantities:
        made += [Variable(f"{name}.{suffix}", unit, about, "output") for name, unit in ys]
    gain = "fault: relative change of the command's effect"
    bias = "fault: added to what is measured"
    made += [Variable(f"fault.gain.{name}", "", gain, "parameter") for name, _ in us]
    made += [Variable(f"fault.bias.{name}", unit, bias, "parameter") for name, unit in ys]
    made += [
        Variable(each.name, each.unit, f"from {each.low:g} to {each.high:g}", "parameter", value)
        for each, value in parameters
    ]
    made += [
        Variable(f"start.{name}", unit, f"start of the state {name}", "fixed", value)
        for name, unit, value in starts
    ]
    made.append(Variable("seed", "", "seed of the noise", "seed"))
    made.append(Variable("noise", "", "whether outputs are drawn from their distribution", "noise"))
    if ranged:
        about = "whether commands or states are outside the training range, where outputs are "
        made.append(Variable("outside_training", "", f"{about}extrapolated", "outside"))
    return list(_distinct(made))


def _distinct(variables: Sequence[Variable]) -> Iterator[Variable]:
    """Variables with names that XML can hold, each once."""
    taken: set[str] = set()
    for each in variables:
        name = base = re.sub(r"\s+", " ", _printable(each.name)).strip() or "unnamed"
        number = 2
        while name in taken:
            name, number = f"{base}.{number}", number + 1
        taken.add(name)
        unit, about = _printable(each.unit), _printable(each.about)
        yield replace(each, name=name, unit="" if unit == "1" else unit, about=about)


def _printable(text: str) -> str:
    """A text without characters that XML forbids."""
    allowed = re.sub(r"[^\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", " ", text)
    return allowed.strip()


CAUSALITY = {
    "time": ("independent", "continuous"),
    "input": ("input", "continuous"),
    "output": ("output", "continuous"),
    "parameter": ("parameter", "tunable"),
    "fixed": ("parameter", "fixed"),
    "seed": ("parameter", "fixed"),
    "noise": ("parameter", "tunable"),
    "outside": ("output", "discrete"),
}
"""Causality and variability by role."""
OUTPUTS = ("output", "outside")
"""Roles of outputs."""


def token_of(source: str) -> str:
    """The identity of an FMU, from its source code."""
    return "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, f"retwin:{source}")) + "}"


def description(
    version: str,
    identifier: str,
    token: str,
    about: str,
    variables: Sequence[Variable],
    period: float,
) -> bytes:
    """The file modelDescription.xml.

    Parameters
    ----------
    version : str
        "2.0" or "3.0".
    identifier : str
        Name of the binary.
    token : str
        See `token_of`.
    about : str
        What the twin is.
    variables : sequence of Variable
        Of `variables_of`.
    period : float
        Sample period in s.

    """
    two = version == "2.0"
    shown = [(i, each) for i, each in enumerate(variables) if not (two and each.role == "time")]
    return _fill(
        "modelDescription.xml",
        version=version,
        two=two,
        identifier=identifier,
        token=token,
        about=_printable(about),
        retwin=__version__,
        units=sorted({each.unit for each in variables if each.unit}),
        period=period,
        shown=shown,
        causalities=CAUSALITY,
        outputs=OUTPUTS,
    )


def build_description(identifier: str) -> bytes:
    """The file sources/buildDescription.xml of FMI 3.0."""
    return _fill("buildDescription.xml", identifier=identifier)


def _fill(name: str, **values: Any) -> bytes:
    """The file of that name, by its template."""
    made = Environment(
        undefined=StrictUndefined, autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    template = resources.files(__package__).joinpath(f"{name}.j2").read_text("utf-8")
    return made.from_string(template).render(values).encode()
