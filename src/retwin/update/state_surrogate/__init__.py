"""State equations that stand in for a twin whose own are not accessible, learned by simulating it.

Belongs here: what a `StateTwin` learns from a twin. Not here: models of measured outputs (see
`blackbox`), and networks without state equations (see `surrogate`).
"""

from retwin.update.state_surrogate.fitting import (
    FittedStateSurrogate,
    StateSurrogate,
    fit_state_surrogate,
)

__all__ = ["FittedStateSurrogate", "StateSurrogate", "fit_state_surrogate"]
