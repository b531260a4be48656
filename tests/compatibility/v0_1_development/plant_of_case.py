"""The code that case.toml names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAP = np.array([[1.0, 0.5, -0.3], [-0.4, 0.8, 0.6]])


def plant(commands: NDArray, *, gain: float = 1.0, bend: float = 0.1) -> NDArray:
    """A memoryless plant of two inputs and three outputs."""
    return gain * (commands + bend * commands**2) @ MAP
