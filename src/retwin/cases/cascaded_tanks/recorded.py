"""The recorded data of the tanks: one class, and the twin's channels."""

from __future__ import annotations

from retwin.cases.cascaded_tanks.twin import TANKS
from retwin.cases.recorded import RecordedCase
from retwin.data.trajectories import HEALTHY

RECORDED = RecordedCase((HEALTHY,), TANKS)
"""What files of the tanks' trajectories need of their case."""
