"""The monitor's page and its HTTP interface, for browsers, machines and Prometheus."""

from __future__ import annotations

from retwin._lazy import names
from retwin.checks import needs_extra

needs_extra("fastapi", "monitor", "answers requests")  # which the modules import by its name

_HOME = {"create_app": "app", "listening": "serve", "serving": "serve"}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
