"""The equations of a `StateTwin` as JSON: operations on numbers, which run no code when read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, TypeVar

from retwin.checks import one_of, require
from retwin.data.trajectories import Channels
from retwin.twins.compiled.program import OPERATIONS, Node, Program
from retwin.twins.equations.state import State
from retwin.twins.limits import Limits
from retwin.twins.wrappers.parametric import Parameter

if TYPE_CHECKING:  # describing a twin needs no torch, which takes seconds to import
    from retwin.twins.compiled.model import Model


Kind = TypeVar("Kind")


def equations_of(twin: Any) -> dict[str, Any]:
    """A `StateTwin` as JSON values."""
    model = twin.model
    nodes = model.program.needed([*model.slope, *model.outputs])
    place = {node.index: i for i, node in enumerate(nodes)}
    return {
        "operations": [
            [node.op, [place[each.index] for each in node.args], node.value] for node in nodes
        ],
        "slope": [place[each.index] for each in model.slope],
        "results": [place[each.index] for each in model.outputs],
        "discrete": model.discrete,
        "states": [asdict(each) for each in twin.states],
        "parameters": [asdict(each) for each in twin.parameters],
        "inputs": [twin.inputs.names, twin.inputs.units],
        "outputs": [twin.outputs.names, twin.outputs.units],
        "rate": twin.rate,
        "substeps": twin.substeps,
        "interpolation": twin.interpolation,
        "limits": None if twin.limits is None else _write_limits(twin.limits),
        "delays": twin.delays,
        "learned": twin.learned,
    }


def equations_from(kind: type[Kind], about: dict[str, Any]) -> Kind:
    """The twin of that class, `StateTwin`, that `equations_of` described.

    Raises
    ------
    InputError, KeyError, TypeError, ValueError
        The description is damaged.

    """
    from retwin.twins.compiled.model import Model

    states = tuple(State(**each) for each in about["states"])
    parameters = tuple(Parameter(**each) for each in about["parameters"])
    inputs, outputs = (
        Channels(*(tuple(part) for part in about[name])) for name in ("inputs", "outputs")
    )
    program = Program()
    variables = program.variables(x=len(states), u=len(inputs), p=len(parameters))
    known = {node.value: node for group in variables.values() for node in group}
    nodes: list[Node] = []
    for op, args, value in about["operations"]:
        require(
            (op in OPERATIONS or op == "constant" or (op == "variable" and value in known))
            and all(isinstance(i, int) and 0 <= i < len(nodes) for i in args),
            "operations",
            expected="known operations on earlier ones",
            got=f"{op} of {args}",
            remedy="save the model again",
        )
        earlier = [nodes[i] for i in args]
        if op in OPERATIONS:
            nodes.append(program.node(op, *earlier))
        else:
            nodes.append(known[value] if op == "variable" else program.constant(value))
    slope, results = ([nodes[i] for i in about[name]] for name in ("slope", "results"))
    fits = (len(slope), len(results)) == (len(states), len(outputs))
    expected = f"{len(states)} states and {len(outputs)} outputs as results"
    got = f"{len(slope)} and {len(results)}"
    require(fits, "operations", expected=expected, got=got, remedy="save the model again")
    discrete = one_of("discrete", about["discrete"], (True, False))
    model = Model(program, variables, slope, results, discrete)
    twin = kind(  # type: ignore[call-arg]  # which this module does not import
        states,
        _Evaluated(model, "outputs"),
        inputs,
        outputs,
        float(about["rate"]),
        **{"step" if model.discrete else "derivative": _Evaluated(model, "slope")},
        parameters=parameters,
        substeps=about["substeps"],
        interpolation=about["interpolation"],
        limits=None if about["limits"] is None else _read_limits(**about["limits"]),
        delays=about.get("delays", {}),
        learned=one_of("learned", about.get("learned", False), (True, False)),
    )
    # Traced again, the same operations would take a hundred times as long to load.
    vars(twin)["model"] = model
    return twin


def _write_limits(limits: Limits) -> dict[str, Any]:
    """Limits as JSON, which has no infinity."""
    low, high = (
        [each if isfinite(each) else None for each in s] for s in (limits.low, limits.high)
    )
    return {"low": low, "high": high, "outside": limits.outside}


def _read_limits(low: list, high: list, outside: Any) -> Limits:
    return Limits(
        tuple(-inf if each is None else each for each in low),
        tuple(inf if each is None else each for each in high),
        outside,
    )


class _Evaluated:
    """A part of a model as a function of named tuples, as a user would write it."""

    def __init__(self, model: Model, part: str) -> None:
        self.model = model
        self.part = part

    def __call__(self, x: Sequence[Any], u: Sequence[Any], p: Sequence[Any]) -> Any:
        return tuple(self.model.evaluate(self.part, x, u, p))
