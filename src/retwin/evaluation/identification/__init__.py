"""Validation of identified parameters: what the data determine, and the error before and after.

Belongs here: what is computed from a result of `rt.identify` and measured trajectories. Not here:
the search and the posterior (see `update.identification`).
"""

from retwin.evaluation.identification.hold_out import hold_out
from retwin.evaluation.identification.parameters import Direction, ParameterEstimate
from retwin.evaluation.identification.residual_tests import InputTest, ResidualTest
from retwin.evaluation.identification.validation import (
    Identification,
    OutputError,
    RMSError,
    validate_identification,
)

__all__ = [
    "Direction",
    "Identification",
    "InputTest",
    "OutputError",
    "ParameterEstimate",
    "RMSError",
    "ResidualTest",
    "hold_out",
    "validate_identification",
]
