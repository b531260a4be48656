"""Offsets of actuators over many trajectories: a bias that persists though no segment shows it.

A diagnosis by inversion estimates the offset of each actuator in each segment. A bias that is not
larger than the offsets of a healthy machine is improbable in none of them, and its evidence is lost
where the spread of the prior, which is learned from few trajectories, is too large. Estimated
offsets of the monitor's own calibration have the spread that matters, whatever the outputs show of
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from retwin.serialisation.models import check_weights
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault
from retwin.update.dynamics.filter.noise import CERTAIN

SIZES = (1 / 6, 1 / 2, 5 / 6)
"""Sizes of a bias that are tried, as shares of the way from its smallest to its largest size on a
logarithmic scale: one of them is within a factor of 1.3 of the true one where these differ five
times."""
MAX_LOG_RATIO = np.log(5.0)
"""Nats by which one offset may be evidence for a bias: a bias shows in many, and a single one may
be an outlier, of which the calibration has too few to know how often they come."""
FARTHEST = 1e6
"""Standard deviations up to which offsets are distinguished, so that squares stay finite."""
DEGREES = (2.5, 100.0)
"""Degrees of freedom of Student's distribution that are tried: below 2 it has no variance, and
above 100 it is a normal one."""
WORSE = CERTAIN**2 / 2
"""Nats by which degrees of freedom may be less likely than the best: 95 % in each direction."""


@dataclass(frozen=True, eq=False)
class OffsetModel:
    """The distribution of the offsets that are estimated in healthy trajectories.

    Each is Student's t, independently of the others. What few trajectories leave uncertain makes
    ratios smaller: the deviation is increased by `kappa`, and of all degrees of freedom with which
    the calibration agrees the healthy machine has those that explain an offset best. So the ratio
    has an expectation of at most 1 for each of these distributions. One offset counts by a factor
    of 5 at most.

    Attributes
    ----------
    mean, deviation : NDArray
        (d_u,), in the units of the commands; a deviation of 0 where none was ever estimated.
    kappa : NDArray
        (d_u,), by how much the deviation may be larger: exp(1.645 s) with the jackknife's standard
        error s of its logarithm, which leaves out one trajectory after the other.
    degrees : NDArray
        (3,), the fewest, the most likely and the most degrees of freedom.

    """

    mean: NDArray
    deviation: NDArray
    kappa: NDArray
    degrees: NDArray

    def ratio(self, offsets: NDArray, faults: Iterable[Fault | None]) -> NDArray:
        """Log likelihood ratios of biases to the healthy machine.

        The bias of an actuator has one size in all segments and trajectories, and any sign in each.

        Parameters
        ----------
        offsets : NDArray
            (n, M, d_u), NaN where there is none.
        faults : iterable of Fault or None
            Of which the B open biases of actuators are taken.

        Returns
        -------
        NDArray
            (n, B, 3) for three sizes of each; 0 where no offset was estimated.

        """
        made = [self._ratio(offsets[:, :, each.actuator], each) for each in biases(faults)]
        return np.stack(made, axis=1) if made else np.zeros((len(offsets), 0, len(SIZES)))

    def _ratio(self, offsets: NDArray, fault: ActuatorBias) -> NDArray:
        own = fault.actuator
        if not self.deviation[own] > 0:
            return np.zeros((len(offsets), len(SIZES)))
        scale = self.kappa[own] * self.deviation[own]
        error = (np.nan_to_num(offsets, nan=self.mean[own]) - self.mean[own]) / scale
        error = np.clip(error, -FARTHEST, FARTHEST)
        healthy = np.max([_log_density(error, each) for each in self.degrees], axis=0)
        # Smallest size that is tried, in standard deviations: of less there is no evidence.
        low, high = (max(each / scale, 0.1) for each in fault.size)
        made = []
        for share in SIZES:
            size = low ** (1 - share) * high**share
            signs = [_log_density(error + sign * size, self.degrees[1]) for sign in (-1, 1)]
            gain = np.minimum(np.logaddexp(*signs) - np.log(2) - healthy, MAX_LOG_RATIO)
            made.append(np.where(np.isfinite(offsets), gain, 0.0).sum(axis=1))
        return np.stack(made, axis=1)

    def arrays(self) -> dict[str, NDArray]:
        """Arrays by name."""
        return {f"offset_{name}": each for name, each in vars(self).items()}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray], actuators: int) -> OffsetModel | None:
        """What `arrays` gave; None if it is not among them, InputError if it is no such model."""
        if "offset_mean" not in arrays:
            return None
        parts = [arrays[f"offset_{name}"] for name in ("mean", "deviation", "kappa", "degrees")]
        mean, deviation, kappa, degrees = parts
        right = (
            mean.shape == deviation.shape == kappa.shape == (actuators,)
            and degrees.shape == (3,)
            and all(np.isfinite(each).all() for each in parts)
            and all([(deviation >= 0).all(), (kappa >= 1).all(), (degrees > 2).all()])
        )
        check_weights(right, f"the offsets of {actuators} actuators")
        return cls(mean, deviation, kappa, degrees)


def is_bias(fault: Fault | None) -> TypeGuard[ActuatorBias]:
    """Whether a fault is the bias of an actuator whose size is open."""
    return isinstance(fault, ActuatorBias) and not fault.bias


def biases(faults: Iterable[Fault | None]) -> list[ActuatorBias]:
    """The biases of actuators whose size is open, in their order."""
    return [each for each in faults if is_bias(each)]


def fit_offsets(offsets: NDArray) -> OffsetModel:
    """The distribution of the offsets (n, M, d_u) of healthy trajectories; NaN is missing."""
    count = np.isfinite(offsets).sum(axis=(0, 1))
    seen = np.isfinite(offsets).any(axis=1)
    known = (seen.sum(axis=0) >= 3) & (count > seen.sum(axis=0) / 2)
    filled = np.where(np.isfinite(offsets), offsets, 0.0)
    parts = np.stack([np.isfinite(offsets), filled, filled**2]).sum(axis=2)  # (3, n, d_u)
    mean, deviation = _moments(parts.sum(axis=1))
    known &= deviation > 1e-9 * (1e-9 + np.abs(mean))
    deviation = np.where(known, deviation, 0.0)
    # One trajectory less: its segments are not independent of each other.
    logs = np.log(np.maximum(_moments(parts.sum(axis=1)[:, None] - parts)[1], 1e-300))
    spread = ((logs - logs.mean(axis=0)) ** 2).sum(axis=0) * (len(logs) - 1) / len(logs)
    kappa = np.where(known, np.exp(CERTAIN * np.sqrt(spread)), 1.0)
    error = ((offsets - mean) / np.where(known, deviation, np.nan)).ravel()
    return OffsetModel(mean, deviation, kappa, _degrees(error[np.isfinite(error)]))


def _moments(sums: NDArray) -> tuple[NDArray, NDArray]:
    """Mean and standard deviation from counts, sums, and sums of squares (3, ...)."""
    count = np.maximum(sums[0], 1)
    mean = sums[1] / count
    return mean, np.sqrt(np.maximum(sums[2] / count - mean**2, 0.0))


def _degrees(errors: NDArray, *, degrees_tried: int = 60) -> NDArray:
    """The fewest, the most likely and the most degrees of freedom (3,) of standardised errors.

    Parameters
    ----------
    degrees_tried : int, default 60
        Degrees of freedom that are tried between these.

    """
    tried = np.geomspace(*DEGREES, degrees_tried)
    if not len(errors):
        return tried[[0, -1, -1]]
    likelihood = np.array([_log_density(errors, each).sum() for each in tried])
    agree = np.flatnonzero(likelihood >= likelihood.max() - WORSE)
    return tried[[agree[0], likelihood.argmax(), agree[-1]]]


def _log_density(error: NDArray, degrees: float) -> NDArray:
    """Log density of Student's t with a variance of 1."""
    scale = np.sqrt(1 - 2 / degrees)
    return student.logpdf(error / scale, degrees) - np.log(scale)
