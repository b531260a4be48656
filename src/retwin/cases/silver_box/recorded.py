"""The recorded data of the Silverbox: one class, and the twin's channels."""

from __future__ import annotations

from retwin.cases.recorded import RecordedCase
from retwin.cases.silver_box.twin import SILVERBOX
from retwin.data.trajectories import HEALTHY

RECORDED = RecordedCase((HEALTHY,), SILVERBOX)
"""What files of the Silverbox's trajectories need of their case."""
