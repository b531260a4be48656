"""Two tanks: a pump fills the upper one, which drains into the lower one; both can overflow."""

import numpy as np


def levels(commands, pump, upper, lower, start_upper, start_lower, edge, spill):
    """Pump voltages (n, T, 1) to lower levels (n, T, 1) in V, one sample every 4 s."""
    x, y = np.full(len(commands), start_upper), np.full(len(commands), start_lower)
    level = np.empty(commands.shape)
    for sample in range(commands.shape[1]):
        level[:, sample, 0] = np.minimum(y, 10)
        for _ in range(8):  # half a second each; Torricelli: outflow ~ root of the level
            between, over = upper * np.sqrt(x), np.maximum(x - edge, 0)
            x = x + 0.5 * (pump * commands[:, sample, 0] - between - over)
            y = y + 0.5 * (between + spill * over - lower * np.sqrt(y) - np.maximum(y - 10, 0))
            x, y = np.maximum(x, 0), np.maximum(y, 0)
    return level
