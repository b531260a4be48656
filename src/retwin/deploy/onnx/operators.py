"""ONNX translations of torch operators that torch's exporter lacks in the form used here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def translations() -> dict[Callable[..., Any], Callable[..., Any]]:
    """Torch operator to the function that builds its ONNX nodes; needs onnxscript."""
    from onnxscript import opset18

    op: Any = opset18  # it is typed for values, here it builds nodes

    def ints(*values: int) -> Any:
        return op.Constant(value_ints=values)

    def searchsorted(
        boundaries: Any,
        values: Any,
        out_int32: bool = False,
        right: bool = False,
        side: Any = None,
        sorter: Any = None,
    ) -> Any:
        """Count the boundaries (..., K) below each value (..., T); K is small."""
        below = op.LessOrEqual if right else op.Less
        before = below(op.Unsqueeze(boundaries, ints(-2)), op.Unsqueeze(values, ints(-1)))
        return op.ReduceSum(op.Cast(before, to=7), ints(-1), keepdims=0)

    def cummax(values: Any, dim: int) -> Any:
        """Cumulative maximum of (n, K) along the last axis, and its index; K is small."""
        count = op.Shape(values, start=-1)
        square = op.Expand(op.Constant(value_float=1.0), op.Concat(count, count, axis=0))
        seen = op.Greater(op.Trilu(square, upper=0), op.Constant(value_float=0.5))
        lowest = op.Constant(value_float=-3e38)
        candidates = op.Where(seen, op.Unsqueeze(values, ints(-2)), lowest)
        greatest = op.ReduceMax(candidates, ints(-1), keepdims=0)
        return greatest, op.ArgMax(candidates, axis=-1, keepdims=0)

    def amax(values: Any, dim: Any = (), keepdim: bool = False) -> Any:
        """Maximum over some axes, or over all."""
        axes = (dim,) if isinstance(dim, int) else tuple(dim or ())
        kept = int(keepdim)
        return (
            op.ReduceMax(values, ints(*axes), keepdims=kept)
            if axes
            else op.ReduceMax(values, keepdims=kept)
        )

    aten = torch.ops.aten
    return {
        aten.searchsorted.Tensor: searchsorted,
        aten.cummax.default: cummax,
        aten.amax.default: amax,
    }
