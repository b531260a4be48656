"""`Layout`: states of machines as rows of numbers, which are stored and joined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.monitor_state import MonitorState


class Layout:
    """The states of machines of one monitor as rows (n, K) of numbers.

    Parameters
    ----------
    monitor : Monitor
        The monitor.
    digest : str
        The hexadecimal hash of its files: its states are of no use to another one.

    """

    def __init__(self, monitor: Monitor, digest: str = "") -> None:
        self.digest = np.frombuffer(bytes.fromhex(digest), dtype=np.uint8)
        start = monitor.start(1).arrays()
        self._parts = {name: (each.dtype, each.shape[1:]) for name, each in start.items()}
        self._ends = np.cumsum([each[0].size for each in start.values()])
        self.start = self.rows(monitor.start(1))[0]
        """(K,), the state before the first sample."""

    def rows(self, state: MonitorState) -> NDArray:
        """The rows (n, K) of a state."""
        arrays = state.arrays()
        count = len(state.void)
        # Whole numbers and truth values are exact as floats.
        flat = [arrays[name].reshape(count, -1).astype(float) for name in self._parts]
        return np.concatenate(flat, axis=1)

    def state(self, rows: NDArray) -> MonitorState:
        """The state of rows (n, K)."""
        parts = np.split(rows, self._ends[:-1], axis=1)
        return MonitorState.of_arrays(
            {
                name: part.reshape(-1, *shape).astype(dtype)
                for (name, (dtype, shape)), part in zip(self._parts.items(), parts, strict=True)
            }
        )
