"""`Model`: the traced equations of a state-space model, in torch and as C99."""

from __future__ import annotations

import inspect
from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from retwin.checks import require
from retwin.compiler import c_source
from retwin.twins.compiled.program import OPERATIONS, Node, Program
from retwin.twins.compiled.trace import traced

if TYPE_CHECKING:
    from torch import Tensor

EXPORTED = "#ifdef _WIN32\n#define EXPORT __declspec(dllexport)\n#else\n#define EXPORT\n#endif\n"
LOOP = "for (int l = 0; l < LANES; l++)"
"""The loop over simulations that are computed at a time."""


@dataclass(frozen=True, eq=False)
class Model:
    """The equations of a model with states x, commands u and parameters p.

    Attributes
    ----------
    program : Program
        All operations.
    variables : dict of str to tuple of Node
        The nodes of "x", "u" and "p".
    slope, outputs : list of Node
        The derivatives of the states, or the states one sample later; and the outputs.
    discrete : bool
        Whether `slope` holds the states one sample later.

    """

    program: Program
    variables: dict[str, tuple[Node, ...]]
    slope: list[Node]
    outputs: list[Node]
    discrete: bool

    def evaluate(
        self, what: str, x: Sequence[Tensor], u: Sequence[Tensor], p: Sequence[Tensor]
    ) -> list[Tensor]:
        """The values of "slope" or "outputs" at double tensors of one shape, with gradient."""
        import torch

        order, constants = self._orders[what]
        variables = {"x": x, "u": u, "p": p}
        values = dict(constants)
        for letter, nodes in self.variables.items():
            values |= {node.index: variables[letter][i] for i, node in enumerate(nodes)}
        for node in order:
            arguments = [values[each.index] for each in node.args]
            values[node.index] = getattr(torch, node.op)(*arguments)
        return [values[each.index].expand_as(x[0]) for each in getattr(self, what)]

    @cached_property
    def _orders(self) -> dict[str, tuple[list[Node], dict[int, Tensor]]]:
        """The operations of "slope" and of "outputs" in order, and their constants as tensors."""
        import torch

        made = {}
        for what in ("slope", "outputs"):
            needed = self.program.needed(getattr(self, what))
            constants = {
                node.index: torch.tensor(node.value, dtype=torch.float64)
                for node in needed
                if node.op == "constant"
            }
            made[what] = ([node for node in needed if node.op in OPERATIONS], constants)
        return made

    def delayed(self, delays: Sequence[tuple[int, int]]) -> Model:
        """The model whose commands, of these indices, are delayed by parameters of these indices.

        Its commands are those of `interpolation.delayed`.
        """
        program, count = Program(), len(self.variables["u"])
        sizes = {letter: len(nodes) for letter, nodes in self.variables.items()}
        variables = program.variables(**sizes | {"u": count + len(delays)})
        known = {
            node.index: made
            for letter, nodes in self.variables.items()
            for node, made in zip(nodes, variables[letter], strict=False)
        }
        for k, (place, parameter) in enumerate(delays):
            moved = variables["p"][parameter] * variables["u"][count + k]
            known[self.variables["u"][place].index] = variables["u"][place] + moved
        for node in self.program.needed([*self.slope, *self.outputs]):
            if node.op in OPERATIONS:
                known[node.index] = program.node(node.op, *(known[a.index] for a in node.args))
            elif node.op == "constant":
                known[node.index] = program.constant(float(node.value))
        slope, outputs = ([known[node.index] for node in own] for own in (self.slope, self.outputs))
        return Model(program, variables, slope, outputs, self.discrete)

    @cached_property
    def source(self) -> str:
        """The model and its simulation in C99, without memory allocation."""
        return "\n".join([EXPORTED, self.steps_source, c_source(__package__, "simulate.c")])

    @cached_property
    def steps_source(self) -> str:
        """The model and its steps from sample to sample in C99, all static."""
        x, p = self.variables["x"], self.variables["p"]
        functions = []
        for name, nodes in (("slope", self.slope), ("output", self.outputs)):
            by = [[self.program.derivatives(nodes, each) for each in group] for group in (x, p)]
            jacobians = [
                (letter, [column[i] for i in range(len(nodes)) for column in columns])
                for letter, columns in zip(("fx", "fp"), by, strict=True)
            ]
            functions.append(self._function(name, [("f", nodes)]))
            functions.append(self._function(f"{name}_jacobian", [("f", nodes), *jacobians]))
        sizes = {"NQ": len(p) + len(x)}
        return "\n".join([*self._head(sizes), *functions, c_source(__package__, "steps.c")])

    def lanes_source(self, lanes: int) -> str:
        """The model in C99 for several simulations at a time, with derivatives by the states.

        All arrays have a last axis of `lanes` simulations, over which each operation is a loop.
        """
        x = self.variables["x"]
        functions = []
        for name, nodes in (("slope", self.slope), ("output", self.outputs)):
            columns = [self.program.derivatives(nodes, each) for each in x]
            by_state = [column[i] for i in range(len(nodes)) for column in columns]
            results = [("f", nodes), ("fx", by_state)]
            functions.append(self._function(f"{name}_jacobian", results, lanes=True))
        return "\n".join([EXPORTED, *self._head({"LANES": lanes}), *functions])

    def _head(self, sizes: dict[str, int]) -> list[str]:
        """What stands above all functions: the sizes of the model, and others."""
        x, u, p = (self.variables[name] for name in "xup")
        own = {"NX": len(x), "NU": len(u), "NP": len(p), "NY": len(self.outputs)}
        own |= {**sizes, "DISCRETE": int(self.discrete)}
        lines = "".join(f"#define {name} {size}\n" for name, size in own.items())
        return ["#include <math.h>\n", lines]

    def _function(
        self, name: str, results: Sequence[tuple[str, Sequence[Node]]], *, lanes: bool = False
    ) -> str:
        """A C function that writes each of `results` to an array of that name."""
        arrays = "".join(f", double *{array}" for array, _ in results)
        lines = [
            f"static void {name}(const double *x, const double *u, const double *p{arrays})",
            "{",
            *(f"    (void){array};" for array in ("x", "u", "p", *(a for a, _ in results))),
        ]
        for node in self.program.needed(each for _, nodes in results for each in nodes):
            if node.op in OPERATIONS:
                text = OPERATIONS[node.op].format(*(_write(each, lanes) for each in node.args))
                lines += _assign(f"v{node.index}", text, lanes)
        for array, nodes in results:
            for i, node in enumerate(nodes):
                place = f"{array}[{i} * LANES + l]" if lanes else f"{array}[{i}]"
                loop = f"{LOOP} " if lanes else ""
                lines.append(f"    {loop}{place} = {_write(node, lanes)};")
        return "\n".join([*lines, "}\n"])


def _assign(name: str, text: str, lanes: bool) -> list[str]:
    """Lines of C that compute a number, or one per lane."""
    if not lanes:
        return [f"    const double {name} = {text};"]
    return [f"    double {name}[LANES];", f"    {LOOP} {name}[l] = {text};"]


def _write(node: Node, lanes: bool) -> str:
    """How C refers to a node."""
    if node.op == "variable":
        return f"{str(node.value)[:-1]} * LANES + l]" if lanes else str(node.value)
    if node.op == "constant":
        number = repr(node.value).replace("inf", "INFINITY").replace("nan", "NAN")
        return f"({number})" if number[0] == "-" else number
    return f"v{node.index}[l]" if lanes else f"v{node.index}"


def trace_model(
    function: Callable[..., Any],
    output: Callable[..., Any],
    names: Sequence[Sequence[str]],
    outputs: int,
    *,
    discrete: bool,
) -> Model:
    """Trace the equations of a model.

    Parameters
    ----------
    function, output : callable
        From named tuples x, u, p of scalars to the derivatives of the states (or the states one
        sample later), and to the outputs.
    names : sequence of three sequences of str
        Names of states, commands and parameters, by which the functions find them.
    outputs : int
        The number of outputs.
    discrete : bool
        Whether `function` gives the states one sample later.

    Returns
    -------
    Model
        The traced equations.

    Raises
    ------
    InputError
        A function cannot be traced, or returns another number of results.

    """
    program = Program()
    listed = dict(zip("xup", names, strict=True))
    variables = program.variables(**{letter: len(own) for letter, own in listed.items()})
    groups = []
    for letter, own in listed.items():
        group = namedtuple(letter, own, rename=True)  # type: ignore[misc]
        groups.append(group(*variables[letter]))
    role = "step" if discrete else "derivative"
    slope = traced(function, program, groups, len(names[0]), role)
    made = traced(output, program, groups, outputs, "output")
    return Model(program, variables, slope, made, discrete)


def with_parameters(function: Callable[..., Any] | None) -> Callable[..., Any]:
    """A function of x, u and p, where the user's may leave out p."""
    expected = "functions of x, u and p"
    remedy = "give functions that can be called"
    require(callable(function), "output", expected=expected, got=repr(function), remedy=remedy)
    assert function is not None
    places = [
        each
        for each in inspect.signature(function).parameters.values()
        if each.default is each.empty and each.kind is not each.VAR_KEYWORD
    ]
    if len(places) == 2 and all(each.kind is not each.VAR_POSITIONAL for each in places):
        return lambda x, u, p: function(x, u)
    return function
