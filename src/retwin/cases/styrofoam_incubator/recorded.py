"""The recorded data of the incubator: one class, and the twin's channels."""

from __future__ import annotations

from retwin.cases.recorded import RecordedCase
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.data.trajectories import HEALTHY

RECORDED = RecordedCase((HEALTHY,), INCUBATOR)
"""What files of the incubator's trajectories need of their case."""
