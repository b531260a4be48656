"""Monitoring of a running machine by its twin, with false alarms no more often than promised.

Belongs here: what turns streams of measured samples into scores, evidence and alarms, the promise
that goes with them, the causes of alarms, and what is stored of all that. Not here: fitting of
twins, and evidence for faults of whole records (see `diagnosis`).
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "audit": "Audit Entry export_log read_log verify",
        "bets": "Dependence Location Scale Tails",
        "cause": "Cause find_causes possible_causes",
        "comparison": "compare",
        "decision": "Decision FalseAlarmTest decide",
        "detector": "Detector DetectorState",
        "disturbance": "Disturbance DisturbanceState fit_disturbance",
        "explanations": "Explanations",
        "fitting": "fit_monitor",
        "gate": "Gate",
        "live": "Live",
        "machine": "Counts Recent",
        "monitor": "Monitor",
        "monitor_state": "MonitorState",
        "promise": "Promise false_alarms",
        "registry": "Registry Version",
        "samples": "Samples Trajectory",
        "scores": "ConformalScores fit_scores resolution",
        "slack": "Slack effective_samples",
        "status": "AssetStatus Received",
        "store": "Store",
        "trajectories": "TrajectoryMonitor",
        "trajectory_fitting": "fit_trajectory_monitor",
        "trajectory_state": "TrajectoryState",
        "updates": "Asset Committed Update",
        "validity": "Validity ValidityState",
        "watched": "Alarm Watched",
        "watched_trajectories": "TrajectoryAlarm WatchedTrajectories",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
