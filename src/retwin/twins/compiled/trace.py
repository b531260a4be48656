"""Tracing: what a function does with scalar tensors of torch becomes a `Program`.

The user's function is called with tensors whose elements are nodes. torch expresses every call in
its own few operators, and each of these has a rule here. An operator without a rule, such as one
that needs the number in a tensor, is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.errors import InputError
from retwin.twins.compiled.program import COMPARISONS, OPERATIONS, Node, Program

ELEMENTWISE: dict[str, Callable[..., Node]] = {
    **{op: (lambda *args, op=op: args[0].program.node(op, *args)) for op in OPERATIONS},
    "log10": lambda a: a.program.node("log", a) * (1 / np.log(10.0)),
    "log2": lambda a: a.program.node("log", a) * (1 / np.log(2.0)),
    "square": lambda a: a * a,
    "reciprocal": lambda a: a.program.node("div", 1.0, a),
    "rsqrt": lambda a: a.program.node("div", 1.0, a.program.node("sqrt", a)),
    "sigmoid": lambda a: _sigmoid(a),
    "silu": lambda a: a * _sigmoid(a),
    "relu": lambda a: _extreme("ge", a, a.program.constant(0.0)),
    "abs": lambda a: _where("lt", a, 0.0, a.program.node("neg", a), a),
    "sign": lambda a: _where("gt", a, 0.0, 1.0, _where("lt", a, 0.0, -1.0, a)),
    "sgn": lambda a: ELEMENTWISE["sign"](a),
    "maximum": lambda a, b: _extreme("ge", a, b),
    "minimum": lambda a, b: _extreme("le", a, b),
    "bitwise_not": lambda a: a.program.node("logical_not", a),
    "bitwise_and": lambda a, b: a.program.node("logical_and", a, b),
    "bitwise_or": lambda a, b: a.program.node("logical_or", a, b),
}
"""Operators that act on each element, from nodes to a node."""
SHAPES: dict[str, Callable[..., Any]] = {
    "view": lambda a, shape: a.reshape(shape),
    "_unsafe_view": lambda a, shape: a.reshape(shape),
    "expand": lambda a, shape: np.broadcast_to(
        a, [_keep_length(a, shape, i) for i in range(len(shape))]
    ),
    "permute": lambda a, axes: a.transpose(axes),
    "t": lambda a: a.T,
    "transpose": lambda a, first, second: a.swapaxes(first, second),
    "unsqueeze": lambda a, axis: np.expand_dims(a, axis),
    "squeeze": lambda a, *axis: a.squeeze(*map(_axes, axis)),
    "select": lambda a, axis, index: a.take(index, axis),
    "slice": lambda a, axis=0, start=None, end=None, step=1: a[
        (slice(None),) * (axis % a.ndim) + (slice(start, end, step),)
    ],
    "stack": lambda parts, axis=0: np.stack(parts, axis),
    "cat": lambda parts, axis=0: np.concatenate(parts, axis),
    "unbind": lambda a, axis=0: list(np.moveaxis(a, axis, 0)),
    "clone": lambda a: a,
    "alias": lambda a: a,
    "mm": lambda a, b: a @ b,
    "mv": lambda a, b: a @ b,
    "dot": lambda a, b: a @ b,
    "addmm": lambda c, a, b: c + a @ b,
    "sum": lambda a, axis=None, keepdim=False: a.sum(_axes(axis), keepdims=keepdim),
}
"""Operators that rearrange, add or multiply elements, on arrays of nodes."""


NUMPY = {"absolute": "abs", "fabs": "abs", "power": "pow", "float_power": "pow"}
"""Names in torch of functions of numpy that have another one there."""


def traced(
    function: Callable[..., Any], program: Program, groups: Sequence[Any], count: int, role: str
) -> list[Node]:
    """The results of a function as nodes of a program.

    Parameters
    ----------
    function : callable
        It gets one argument per group and returns `count` scalars: a tensor, or a sequence of
        tensors and numbers.
    program : Program
        To which the operations are added.
    groups : sequence of named tuples of Node
        The function gets the same named tuples with a scalar tensor for each node.
    count : int
        The number of results.
    role : str
        The name of the function in messages.

    Returns
    -------
    list of Node
        One per result.

    Raises
    ------
    InputError
        The function does what cannot be traced, or does not return `count` scalars.

    """
    arguments = [type(each)(*(_Traced(_array(node)) for node in each)) for each in groups]
    with torch.no_grad():
        try:
            returned = function(*arguments)
        except _RefusedError as error:
            known = sorted(e for e in ELEMENTWISE if e not in COMPARISONS and "bitwise" not in e)
            expected = "operations of torch or numpy on scalars, without branches that depend "
            expected += "on them"
            remedy = "use torch.where, torch.sqrt, … in place of if and math; there are "
            remedy += f"{', '.join(known)}"
            raise InputError(role, expected=expected, got=str(error), remedy=remedy) from None
    if isinstance(returned, Tensor):
        returned = returned.unbind() if returned.ndim else [returned]
    returned = returned if isinstance(returned, Sequence) else [returned]
    results = [_element(program, each) for each in returned]
    good = len(results) == count and all(isinstance(each, Node) for each in results)
    if not good:
        expected = f"a function that returns {count} scalars, one for each name in order"
        got = f"{len(results)}: {', '.join(type(each).__name__ for each in returned)}"
        remedy = "return a tuple with one tensor without axes, or one number, for each"
        raise InputError(role, expected=expected, got=got, remedy=remedy)
    return results


class _RefusedError(TypeError):
    """An operator of torch that has no counterpart in a program."""


class _Traced(Tensor):
    """A tensor without numbers, whose elements are nodes."""

    nodes: NDArray

    @staticmethod
    def __new__(cls, nodes: NDArray, dtype: torch.dtype = torch.float64) -> _Traced:
        made = Tensor._make_wrapper_subclass(cls, nodes.shape, dtype=dtype)
        made.nodes = nodes
        return made

    def __array__(self, dtype: Any = None) -> NDArray:
        raise _RefusedError(_describe("item"))

    def __array_ufunc__(self, ufunc: Any, method: str, *given: Any, **options: Any) -> Any:
        """A function of numpy, by that of torch."""
        if method != "__call__" or options:
            raise _RefusedError(f"numpy.{ufunc.__name__} with {method or 'options'}")
        return _by_torch(ufunc.__name__, given)

    def __array_function__(self, function: Any, types: Any, given: Any, options: Any) -> Any:
        """Such as `numpy.where`, by that of torch."""
        if options:
            raise _RefusedError(f"numpy.{function.__name__} with {', '.join(options)}")
        return _by_torch(function.__name__, given)

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # declared by torch as the default's own
        cls, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """The operator on nodes."""
        name, options = function.overloadpacket.__name__, dict(kwargs or {})
        program = next(each.nodes.flat[0].program for each in _flat(args) if type(each) is cls)
        if name in ("clamp", "clamp_min", "clamp_max"):
            return _clamp(name, *args, **options)
        if name in ("add", "sub", "rsub") and options.pop("alpha", 1) != 1:
            raise _RefusedError(f"torch.{name} with alpha")
        if name == "rsub":
            name, args = "sub", args[1::-1]
        if name == "_to_copy":
            return _convert(args[0], program, options.get("dtype", args[0].dtype))
        inexact = any(each is not None for each in options.values()) and name != "sum"
        if inexact or (name not in ELEMENTWISE and name not in SHAPES):
            raise _RefusedError(_describe(name))
        arrays = [_arrays(program, each) for each in args]
        truth = name in COMPARISONS or name.startswith("bitwise_")
        if name in SHAPES:
            dtype = next(each.dtype for each in _flat(args) if type(each) is cls)
            made = SHAPES[name](*arrays, **options)
            if isinstance(made, list):
                return [_Traced(_array(each), dtype) for each in made]
            return _Traced(_array(made), dtype)
        flags = [each.dtype is torch.bool for each in _flat(args) if isinstance(each, Tensor)]
        if all(flags) and name not in COMPARISONS and not truth:
            raise _RefusedError(f"torch.{name} of truth values")
        arrays = [
            each if isinstance(each, np.ndarray) else program.constant(each) for each in arrays
        ]
        made = np.frompyfunc(ELEMENTWISE[name], len(arrays), 1)(*arrays)
        return _Traced(_array(made), torch.bool if truth else torch.float64)


def _by_torch(name: str, given: Sequence[Any]) -> Any:
    """What torch has for a function of numpy, of scalars and tensors."""
    function = getattr(torch, NUMPY.get(name, name), None)
    if function is None:
        raise _RefusedError(f"numpy.{name}")
    own = [
        e if isinstance(e, Tensor) else torch.tensor(float(e), dtype=torch.float64) for e in given
    ]
    return function(*own)


def _array(value: Any) -> NDArray:
    """An array of objects; a lone node has no axes."""
    if isinstance(value, np.ndarray):
        return value
    array = np.empty((), dtype=object)
    array[()] = value
    return array


def _arrays(program: Program, value: Any) -> Any:
    """An argument of an operator with arrays of nodes in place of tensors and numbers."""
    if isinstance(value, _Traced):
        return value.nodes
    if isinstance(value, Tensor):
        constant = np.frompyfunc(program.constant, 1, 1)
        return _array(constant(value.detach().to(torch.float64).numpy()))
    if isinstance(value, list | tuple) and any(isinstance(each, Tensor) for each in value):
        return [_arrays(program, each) for each in value]
    return value


def _element(program: Program, value: Any) -> Any:
    """The node of a scalar that a function returned; anything else as it is."""
    if isinstance(value, Tensor) and value.ndim == 0:
        return _arrays(program, value)[()]
    return program.constant(value) if isinstance(value, int | float) else value


def _flat(args: Any) -> list[Any]:
    return [each for arg in args for each in (arg if isinstance(arg, list | tuple) else (arg,))]


def _describe(name: str) -> str:
    if name in ("_local_scalar_dense", "detach", "is_nonzero", "item"):
        return "a number taken out of a tensor, by if, float, math or numpy.array"
    return f"torch.{name.removesuffix('_')}{' in place' if name.endswith('_') else ''}"


def _axes(axis: Any) -> Any:
    return tuple(axis) if isinstance(axis, list) else axis


def _keep_length(a: NDArray, shape: Sequence[int], i: int) -> int:
    """The length of an axis that is broadcast, where -1 keeps it."""
    return a.shape[i - len(shape) + a.ndim] if shape[i] == -1 else shape[i]


def _convert(value: _Traced, program: Program, dtype: torch.dtype) -> _Traced:
    """A copy of another type: truth values become 0 and 1."""
    if dtype is value.dtype:
        return value
    if value.dtype is not torch.bool or dtype is not torch.float64:
        raise _RefusedError(f"a conversion to {dtype}; all numbers are torch.float64")
    made = np.frompyfunc(lambda a: program.node("where", a, 1.0, 0.0), 1, 1)(value.nodes)
    return _Traced(_array(made))


def _clamp(name: str, value: _Traced, low: Any = None, high: Any = None, **named: Any) -> _Traced:
    low, high = named.get("min", low), named.get("max", high)
    if name == "clamp_max":
        low, high = None, named.get("max", low)
    if low is not None:
        value = torch.maximum(value, torch.as_tensor(low, dtype=torch.float64))  # type: ignore[assignment]
    if high is not None:
        value = torch.minimum(value, torch.as_tensor(high, dtype=torch.float64))  # type: ignore[assignment]
    return value


def _where(comparison: str, a: Node, b: Node | float, yes: Node | float, no: Node | float) -> Node:
    n = a.program.node
    return n("where", n(comparison, a, b), yes, no)


def _extreme(comparison: str, a: Node, b: Node) -> Node:
    """The larger ("ge") or smaller ("le") of two; NaN if one is, as in torch and unlike fmax."""
    n = a.program.node
    return n("where", n("logical_or", n(comparison, a, b), n("ne", a, a)), a, b)


def _sigmoid(a: Node) -> Node:
    n = a.program.node
    return n("div", 1.0, n("add", n("exp", n("neg", a)), 1.0))
