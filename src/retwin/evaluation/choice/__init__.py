"""Which correction a twin and its records call for, by parts of the records that are left out.

Belongs here: what fits candidates, scores them at one horizon, and takes one. Not here: how a
candidate is fitted (see `update`), and formulas of scores.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "fitted": "CandidateScore Fitted",
        "fitting": "fit",
        "scoring": "ModelScore predict_records score_model",
        "settings": "Choice",
        "surrogates": "StandIn SurrogateSettings stand_in",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
