"""Sums and maxima of log evidences over the alternatives that were tried for each row."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def best_per_row(evidence: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The rows among `rows` (k,), each once, and the index (·,) of the best alternative of each."""
    order = torch.as_tensor(np.lexsort((evidence.numpy(), rows.numpy())))
    different, counts = torch.unique_consecutive(rows[order], return_counts=True)
    return different, order[counts.cumsum(dim=0) - 1]


def added_evidence(total: Tensor, evidence: Tensor, rows: Tensor) -> Tensor:
    """Log sum (R,) of the evidence that each row had and of that (k,) of its alternatives."""
    top = total.scatter_reduce(0, rows, evidence, "amax")
    share = (total - top).exp().index_add(0, rows, (evidence - top[rows]).exp())
    return top + share.log()
