"""The method: surrogate (Eq. 5), corrections g, residual models (Eq. 6-10), identification.

Belongs here: everything that makes a corrected twin from a twin and measured outputs. Not
here: diagnosers, scores, and systems.
"""

from __future__ import annotations

from retwin._lazy import submodules

__getattr__ = submodules(__name__)
