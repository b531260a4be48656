"""Pure functions of arrays that score predictions and simulations.

Belongs here: every number that a page or a command shows and that needs no model. Not here:
anything that runs a twin or a network (see `evaluation`), or draws.
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
