"""`Progress`: the type of functions to which long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Progress"]

Progress = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1."""
