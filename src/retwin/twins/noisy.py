"""`NoisyTwin`: a twin with independent noise on its outputs, at the rate of its sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import HEALTHY, UNLABELLED, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.around import Around, generator_of, simulate_chunk
from retwin.twins.faults import Fault
from retwin.twins.twin import Chunk, Twin, simulate_in_chunks

__all__ = ["NoisyTwin", "interpolate_samples", "readings", "residual_scale"]


@dataclass(frozen=True, eq=False)
class NoisyTwin(Around):
    """Any twin, and independent Gaussian noise on what its sensor reads.

    The rival that takes the gap for noise: right in size, without any shape.

    Parameters
    ----------
    twin: the twin inside.
    scale: (d_y,) standard deviation of a reading, in output units; see `residual_scale`.
    stride: samples per reading of the sensor; between them noise is linear.
    emulated: whether the data that gave the scale were emulated.

    Raises
    ------
    InputError: not one finite scale of at least 0 per output, a stride below 1.

    """

    twin: Twin
    scale: NDArray
    stride: int = 1
    emulated: bool = False

    def __post_init__(self) -> None:
        scale, width = np.asarray(self.scale, dtype=float), len(self.twin.outputs)
        if scale.shape != (width,) or not (np.isfinite(scale) & (scale >= 0)).all():
            raise InputError(
                "scale",
                expected=f"{width} finite numbers of at least 0, one per output",
                got=f"{scale.tolist()}",
                remedy="residual_scale gives them for calibration trajectories",
            )
        if not (isinstance(self.stride, int | np.integer) and self.stride >= 1):
            raise InputError(
                "stride",
                expected="a whole number of at least 1",
                got=repr(self.stride),
                remedy="divide the data's rate by the sensor's",
            )
        object.__setattr__(self, "scale", scale)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; noise comes last, on faulty trajectories too."""

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            rows = np.arange(len(chunk.commands))
            nominal, observed = simulate_chunk(self.twin, chunk, rows, seed=seed)
            count, steps, width = observed.shape
            shape = (count, readings(steps, self.stride), width)
            read = self.scale * generator_of(seed, chunk, 4).normal(size=shape)
            return nominal, observed + interpolate_samples(read, self.stride, steps)

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, emulated=self.emulated
        )


def residual_scale(calibration: Trajectories) -> NDArray:
    """How large the residual of healthy trajectories is: its standard deviation (d_y,) per output.

    In output units, over all that was measured (Eq. 11). Raises InputError for no trajectory, one
    with a fault, or an output that was never measured.
    """
    healthy = np.isin(calibration.labels, (HEALTHY, UNLABELLED))
    if len(calibration) == 0 or not healthy.all():
        raise InputError(
            "calibration",
            expected="healthy trajectories, one at least",
            got=f"{len(calibration)}, {int((~healthy).sum())} of them with a fault",
            remedy=f"take calibration.with_label({HEALTHY!r})",
        )
    if not calibration.mask.any(axis=(0, 1)).all():
        raise InputError(
            "calibration",
            expected="every output measured somewhere",
            got="one that never was",
            remedy="give trajectories in which it is, or leave the output out",
        )
    residual = calibration.residual.astype(np.float64)
    return residual.std(axis=(0, 1), where=calibration.mask)


def readings(steps: int, stride: int) -> int:
    """How many readings, one per `stride` samples, have `steps` samples between them."""
    return (steps - 1) // stride + 2


def interpolate_samples(read: NDArray, stride: int, steps: int) -> NDArray:
    """Samples (n, steps, d) on straight lines between readings (n, r, d), r of `readings`."""
    time = np.arange(steps)
    before, share = time // stride, (time % stride / stride)[:, None]
    return (1 - share) * read[:, before] + share * read[:, before + 1]
