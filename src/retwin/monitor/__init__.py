"""Monitoring of a running machine by its twin, with false alarms no more often than promised.

Belongs here: what turns streams of prediction errors into scores, evidence and alarms, and the
promise that goes with them. Not here: fitting of twins, and causes of alarms (see `diagnosis`).
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "ConformalScores": "scores",
    "Dependence": "bets",
    "Detector": "detector",
    "DetectorState": "detector",
    "Disturbance": "disturbance",
    "DisturbanceState": "disturbance",
    "Location": "bets",
    "Promise": "promise",
    "Scale": "bets",
    "Slack": "slack",
    "Tails": "bets",
    "Validity": "validity",
    "ValidityState": "validity",
    "effective_samples": "slack",
    "false_alarms": "promise",
    "fit_disturbance": "disturbance",
    "fit_scores": "scores",
    "resolution": "scores",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
