"""`Model`: the traced equations of a state-space model, in torch and as C99."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from retwin.compiler import c_source
from retwin.twins.compiled.program import OPERATIONS, Node, Program
from retwin.twins.compiled.trace import traced

if TYPE_CHECKING:
    from torch import Tensor


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

    @cached_property
    def source(self) -> str:
        """The model and its simulation in C99, without memory allocation."""
        exported = (
            "#ifdef _WIN32\n#define EXPORT __declspec(dllexport)\n#else\n#define EXPORT\n#endif\n"
        )
        return "\n".join([exported, self.steps_source, c_source(__package__, "simulate.c")])

    @cached_property
    def steps_source(self) -> str:
        """The model and its steps from sample to sample in C99, all static."""
        x, u, p = (self.variables[name] for name in "xup")
        sizes = {"NX": len(x), "NU": len(u), "NP": len(p), "NY": len(self.outputs)}
        sizes |= {"NQ": len(p) + len(x), "DISCRETE": int(self.discrete)}
        functions = []
        for name, nodes in (("slope", self.slope), ("output", self.outputs)):
            by = [[self.program.derivatives(nodes, each) for each in group] for group in (x, p)]
            jacobians = [
                (letter, [column[i] for i in range(len(nodes)) for column in columns])
                for letter, columns in zip(("fx", "fp"), by, strict=True)
            ]
            functions.append(self._function(name, [("f", nodes)]))
            functions.append(self._function(f"{name}_jacobian", [("f", nodes), *jacobians]))
        parts = [
            "#include <math.h>\n",
            "".join(f"#define {name} {size}\n" for name, size in sizes.items()),
            *functions,
            c_source(__package__, "steps.c"),
        ]
        return "\n".join(parts)

    def _function(self, name: str, results: Sequence[tuple[str, Sequence[Node]]]) -> str:
        """A C function that writes each of `results` to an array of that name."""
        arrays = "".join(f", double *{array}" for array, _ in results)
        lines = [
            f"static void {name}(const double *x, const double *u, const double *p{arrays})",
            "{",
            *(f"    (void){array};" for array in ("x", "u", "p", *(a for a, _ in results))),
        ]
        for node in self.program.needed(each for _, nodes in results for each in nodes):
            if node.op in OPERATIONS:
                text = OPERATIONS[node.op].format(*map(_written, node.args))
                lines.append(f"    const double v{node.index} = {text};")
        for array, nodes in results:
            lines += [f"    {array}[{i}] = {_written(node)};" for i, node in enumerate(nodes)]
        return "\n".join([*lines, "}\n"])


def _written(node: Node) -> str:
    """How C refers to a node."""
    if node.op == "variable":
        return str(node.value)
    if node.op == "constant":
        number = repr(node.value).replace("inf", "INFINITY").replace("nan", "NAN")
        return f"({number})" if number[0] == "-" else number
    return f"v{node.index}"


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
    groups = []
    for letter, own in zip("xup", names, strict=True):
        group = namedtuple(letter, own, rename=True)  # type: ignore[misc]
        groups.append(group(*(program.variable(f"{letter}[{i}]") for i in range(len(own)))))
    role = "step" if discrete else "derivative"
    slope = traced(function, program, groups, len(names[0]), role)
    made = traced(output, program, groups, outputs, "output")
    variables: dict[str, tuple[Node, ...]] = {
        letter: tuple(group) for letter, group in zip("xup", groups, strict=True)
    }
    return Model(program, variables, slope, made, discrete)
