"""Tests of the residuals of a simulation: whether they are white, and depend on the commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from retwin.data.trajectories import Trajectories
from retwin.scores.residuals import autocorrelation, cross_correlation, ljung_box


@dataclass(frozen=True)
class InputTest:
    """The correlation of a residual with an input of the twin, over all lags.

    Attributes
    ----------
    name : str
        The input.
    correlation, lag : float
        The correlation that is largest compared with its limits, and its lag in s; negative lags
        are later commands.
    p_value : float
        Probability of one as large among all lags without any dependence (Bonferroni); NaN where
        it is not defined.

    """

    name: str
    correlation: float
    lag: float
    p_value: float


@dataclass(frozen=True)
class ResidualTest:
    """The residual of one output.

    Attributes
    ----------
    name : str
        The output.
    p_white : float
        p-value of the hypothesis that the residual is white noise (Ljung and Box); NaN where it
        is not defined.
    first_correlation : float
        Its correlation from one sample to the next.
    inputs : tuple of InputTest
        Its correlation with each input.

    """

    name: str
    p_white: float
    first_correlation: float
    inputs: tuple[InputTest, ...]


def residual_tests(
    residual: NDArray, measured: Trajectories, *, negligible: float = 1e-6
) -> tuple[ResidualTest, ...]:
    """Tests of the residuals (n, T, d_y) of each output, NaN where nothing was measured.

    Parameters
    ----------
    negligible : float, default 1e-6
        RMS of a residual, over the standard deviation of the output, below which it is rounding.

    """
    made = []
    for channel, name in enumerate(measured.outputs.names):
        own = residual[..., channel]
        seen = np.isfinite(own)
        spread = float(measured.observed[..., channel][seen].std()) if seen.any() else 0.0
        error = float(np.sqrt(np.mean(own[seen] ** 2))) if seen.any() else 0.0
        if error <= negligible * max(spread, 1e-300):
            made.append(ResidualTest(name, float("nan"), float("nan"), ()))
            continue
        found = autocorrelation(own)
        first = float(found.values[0]) if len(found.values) else float("nan")
        tests = tuple(
            _with_input(own, measured.commands[..., j].astype(float), input_name, measured.rate)
            for j, input_name in enumerate(measured.inputs.names)
        )
        made.append(ResidualTest(name, ljung_box(found)[1], first, tests))
    return tuple(made)


def _with_input(residual: NDArray, command: NDArray, name: str, rate: float) -> InputTest:
    """The largest correlation with one input."""
    if np.ptp(command) == 0:
        return InputTest(name, float("nan"), float("nan"), float("nan"))
    found = cross_correlation(residual, command)
    at = found.largest
    # The 97.5 % quantile of the normal distribution, which the limits of correlations contain.
    deviations = abs(found.values[at]) / found.limits[at] * 1.959964
    p_value = min(1.0, 2 * float(ndtr(-deviations)) * len(found.lags))
    return InputTest(name, float(found.values[at]), float(found.lags[at]) / rate, p_value)
