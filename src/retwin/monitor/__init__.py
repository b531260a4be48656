"""Monitoring of a running machine by its twin, with false alarms no more often than promised.

Belongs here: what turns streams of measured samples into scores, evidence and alarms, the promise
that goes with them, the causes of alarms, and what is stored of all that. Not here: fitting of
twins, and evidence for faults of whole records (see `diagnosis`).
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Alarm": "watched",
    "Asset": "updates",
    "AssetStatus": "status",
    "Audit": "audit",
    "Cause": "cause",
    "Committed": "updates",
    "ConformalScores": "scores",
    "Counts": "machine",
    "Decision": "decision",
    "Dependence": "bets",
    "Detector": "detector",
    "DetectorState": "detector",
    "Disturbance": "disturbance",
    "DisturbanceState": "disturbance",
    "Entry": "audit",
    "Explanations": "explanations",
    "FalseAlarmTest": "decision",
    "Gate": "gate",
    "Live": "live",
    "Location": "bets",
    "Monitor": "monitor",
    "MonitorState": "monitor_state",
    "Promise": "promise",
    "Received": "status",
    "Recent": "machine",
    "Registry": "registry",
    "Samples": "samples",
    "Scale": "bets",
    "Slack": "slack",
    "Store": "store",
    "Tails": "bets",
    "Trajectory": "samples",
    "TrajectoryAlarm": "watched_trajectories",
    "TrajectoryMonitor": "trajectories",
    "TrajectoryState": "trajectory_state",
    "Update": "updates",
    "Validity": "validity",
    "ValidityState": "validity",
    "Version": "registry",
    "Watched": "watched",
    "WatchedTrajectories": "watched_trajectories",
    "compare": "comparison",
    "decide": "decision",
    "effective_samples": "slack",
    "export_log": "audit",
    "false_alarms": "promise",
    "find_causes": "cause",
    "fit_disturbance": "disturbance",
    "fit_monitor": "fitting",
    "fit_scores": "scores",
    "fit_trajectory_monitor": "trajectories",
    "possible_causes": "cause",
    "read_log": "audit",
    "resolution": "scores",
    "verify": "audit",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
