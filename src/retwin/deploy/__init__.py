"""Fitted models and large simulations outside this process.

Belongs here: bundles, exports, and simulations of any size into Zarr folders. Not here: fitting.
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
