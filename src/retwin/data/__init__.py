"""Trajectories of commands and outputs, their segments, and the files they come from.

Belongs here: the data types, file formats, downloads. Not here: anything that simulates, learns or
scores.
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
