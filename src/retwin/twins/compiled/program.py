"""`Program`: a function of a few numbers as a list of operations, each of them one C expression.

Equal operations are one node, so that what a function and its derivatives share is computed once.
The same list is evaluated with torch tensors, written as C99, and differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

FUNCTIONS = (
    *("exp", "log", "log1p", "expm1", "sqrt", "erf", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("sinh", "cosh", "tanh", "floor", "ceil"),
)
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">"} | {
    "ge": ">=",
    "eq": "==",
    "ne": "!=",
    "logical_and": "&&",
    "logical_or": "||",
}
OPERATIONS = (
    {name: f"{name}({{0}})" for name in FUNCTIONS}
    | {name: f"{{0}} {sign} {{1}}" for name, sign in INFIX.items()}
    | {"pow": "pow({0}, {1})", "atan2": "atan2({0}, {1})", "neg": "-{0}"}
    | {"logical_not": "!{0}", "where": "{0} ? {1} : {2}"}
)
"""The C99 expression of each operation, by the name of the function of torch that is the same."""
COMPARISONS = {"lt", "le", "gt", "ge", "eq", "ne", "logical_not", "logical_and", "logical_or"}
"""Operations whose result is a truth value."""


@dataclass(frozen=True, eq=False)
class Node:
    """An operation on earlier nodes, a variable (`x[0]`), or a constant.

    Attributes
    ----------
    program : Program
        The program to which it belongs.
    index : int
        Its place in the program, after those of its arguments.
    op : str
        A key of `OPERATIONS`, "variable" or "constant".
    args : tuple of Node
        The arguments.
    value : float or str
        The number of a constant, the C name of a variable.

    """

    program: Program
    index: int
    op: str
    args: tuple[Node, ...] = ()
    value: float | str = ""

    def __add__(self, other: Node) -> Node:
        return self.program.node("add", self, other)

    def __mul__(self, other: Node) -> Node:
        return self.program.node("mul", self, other)


@dataclass(eq=False)
class Program:
    """Operations in the order in which they can be computed."""

    nodes: list[Node] = field(default_factory=list)
    _known: dict[tuple, Node] = field(default_factory=dict)

    def variable(self, name: str) -> Node:
        """The variable of that C name."""
        return self._intern("variable", (), name)

    def variables(self, **sizes: int) -> dict[str, tuple[Node, ...]]:
        """Variables x[0], x[1], … of each array of C and its size."""
        return {
            letter: tuple(self.variable(f"{letter}[{i}]") for i in range(size))
            for letter, size in sizes.items()
        }

    def constant(self, value: float) -> Node:
        """The constant of that value."""
        return self._intern("constant", (), float(value))

    def node(self, op: str, *args: Node | float) -> Node:
        """An operation; powers with the exponents 0.5 and -4 … 4 become roots and products."""
        nodes = tuple(a if isinstance(a, Node) else self.constant(a) for a in args)
        if op == "mul":
            for one, other in (nodes, nodes[::-1]):
                if one.op == "constant" and one.value == 1.0:
                    return other
        if op == "pow" and nodes[1].op == "constant":
            short = self._power(nodes[0], float(nodes[1].value))
            if short is not None:
                return short
        return self._intern(op, nodes, "")

    def _power(self, base: Node, exponent: float) -> Node | None:
        if exponent == 0.5:
            return self.node("sqrt", base)
        if not exponent.is_integer() or not 1 <= abs(exponent) <= 4:
            return None
        product = base
        for _ in range(int(abs(exponent)) - 1):
            product = product * base
        return product if exponent > 0 else self.node("div", 1.0, product)

    def _intern(self, op: str, args: tuple[Node, ...], value: float | str) -> Node:
        # By its text, in which 0.0 differs from -0.0, and one NaN does not from another.
        key = (op, tuple(each.index for each in args), repr(value))
        if key not in self._known:
            self._known[key] = Node(self, len(self.nodes), op, args, value)
            self.nodes.append(self._known[key])
        return self._known[key]

    def needed(self, outputs: Iterable[Node]) -> list[Node]:
        """The nodes on which `outputs` depend, themselves included, in order."""
        found: dict[int, Node] = {}
        left = list(outputs)
        while left:
            node = left.pop()
            if node.index not in found:
                found[node.index] = node
                left.extend(node.args)
        return [found[index] for index in sorted(found)]

    def derivatives(self, outputs: Sequence[Node], variable: Node) -> list[Node]:
        """The derivative of each output with respect to a variable."""
        tangents: dict[int, Node | None] = {}
        for node in self.needed(outputs):
            if node is variable:
                tangents[node.index] = self.constant(1.0)
            else:
                inner = [tangents[each.index] for each in node.args]
                tangents[node.index] = self._tangent(node, inner) if any(inner) else None
        return [tangents[each.index] or self.constant(0.0) for each in outputs]

    def _tangent(self, node: Node, inner: Sequence[Node | None]) -> Node | None:
        """The derivative of a node, from those of its arguments; None where it is 0."""
        if node.op == "where":
            zero = self.constant(0.0)
            return self.node("where", node.args[0], inner[1] or zero, inner[2] or zero)
        total: Node | None = None
        for partial, tangent in zip(_partials(self, node), inner, strict=True):
            if tangent is None or partial is None:
                continue
            term = partial() * tangent
            total = term if total is None else total + term
        return total


Partial = Callable[[], Node] | None


def _partials(program: Program, node: Node) -> tuple[Partial, ...]:
    """The partial derivative of an operation by each of its arguments; None where it is 0."""
    op, n = node.op, program.node
    if op in COMPARISONS or op in ("floor", "ceil"):
        return (None,) * len(node.args)
    a = node.args[0]
    b = node.args[-1]
    if op in ("add", "sub"):
        second = 1.0 if op == "add" else -1.0
        return lambda: program.constant(1.0), lambda: program.constant(second)
    rules: dict[str, tuple[Partial, ...]] = {
        "neg": (lambda: program.constant(-1.0),),
        "mul": (lambda: b, lambda: a),
        "div": (lambda: n("div", 1.0, b), lambda: n("neg", n("div", node, b))),
        "pow": (
            lambda: b * n("pow", a, n("sub", b, 1.0) if b.op != "constant" else float(b.value) - 1),
            # 0 to a positive power is 0 for every such power.
            lambda: node * n("where", n("eq", a, 0.0), 0.0, n("log", a)),
        ),
        "atan2": (lambda: n("div", b, a * a + b * b), lambda: n("neg", n("div", a, a * a + b * b))),
        "exp": (lambda: node,),
        "expm1": (lambda: n("add", node, 1.0),),
        "log": (lambda: n("div", 1.0, a),),
        "log1p": (lambda: n("div", 1.0, n("add", a, 1.0)),),
        "sqrt": (lambda: n("div", 0.5, node),),
        "erf": (lambda: n("mul", 2 / math.sqrt(math.pi), n("exp", n("neg", a * a))),),
        "sin": (lambda: n("cos", a),),
        "cos": (lambda: n("neg", n("sin", a)),),
        "tan": (lambda: n("add", node * node, 1.0),),
        "sinh": (lambda: n("cosh", a),),
        "cosh": (lambda: n("sinh", a),),
        "tanh": (lambda: n("sub", 1.0, node * node),),
        "asin": (lambda: n("div", 1.0, n("sqrt", n("sub", 1.0, a * a))),),
        "acos": (lambda: n("div", -1.0, n("sqrt", n("sub", 1.0, a * a))),),
        "atan": (lambda: n("div", 1.0, n("add", a * a, 1.0)),),
    }
    return rules[op]
