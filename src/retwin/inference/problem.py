"""`Problem`: the model whose latent variables are inferred, as the engine sees it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    """A dataclass whose fields, tensors and other `Rows`, have a row for each of R problems."""

    shared: ClassVar[tuple[str, ...]] = ()
    """Fields that all rows share."""

    def __getitem__(self, rows: Any) -> Self:
        """Those of some rows."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        kept = {k: v for k, v in own.items() if k not in self.shared and v is not None}
        return replace(self, **{name: value[rows] for name, value in kept.items()})

    def put(self, rows: Tensor, other: Self) -> Self:
        """The same with those of another one in some rows."""
        made = {}
        for name in (each.name for each in fields(self)):
            own, new = getattr(self, name), getattr(other, name)
            inside = isinstance(own, Rows)
            made[name] = own.put(rows, new) if inside else own.index_copy(0, rows, new)
        return replace(self, **made)


@dataclass(frozen=True, eq=False)
class CommonError(Rows):
    """A normal error of known variance that a block of samples has in common.

    Attributes
    ----------
    variance : Tensor
        (R, K, d), in the residual's unit squared.
    block : Tensor
        (R, K), the number of samples of the block that a sample belongs to.

    """

    variance: Tensor
    block: Tensor


class Problem(Protocol):
    """R independent rows of K samples of d outputs, each explained by P latent variables x.

    Attributes
    ----------
    group : Tensor
        (R, K) long, the group of samples with a common noise scale that each sample belongs to.
    measured : Tensor
        (R, K), the share of a sample's outputs that was measured; 0 for a sample without any.
    common : CommonError, optional
        A known error besides the noise.

    """

    @property
    def group(self) -> Tensor:
        """(R, K) long."""

    @property
    def measured(self) -> Tensor:
        """(R, K)."""

    @property
    def common(self) -> CommonError | None:
        """None without such an error."""

    def __getitem__(self, rows: Tensor) -> Problem:
        """The problem of some rows, by their indices."""

    def residual(self, x: Tensor) -> Tensor:
        """Measured minus predicted outputs (R, K, d) for x (R, P)."""

    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residual, and the Jacobian (R, K, d, P) of the predicted outputs."""
