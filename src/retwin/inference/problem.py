"""`Problem`: the model whose latent variables are inferred, as the engine sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True, eq=False)
class CommonError:
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

    def __getitem__(self, rows: Tensor) -> CommonError:
        """That of some rows."""
        return CommonError(self.variance[rows], self.block[rows])


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
