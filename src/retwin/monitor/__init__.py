"""Monitoring of a running machine by its twin, with false alarms no more often than promised.

Belongs here: what turns streams of measured samples into scores, evidence and alarms, the promise
that goes with them, the causes of alarms, and what is stored of all that. Not here: fitting of
twins, and evidence for faults of whole records (see `diagnosis`).
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "detect.bets": "Dependence Location Repetition Scale Tails",
        "detect.detector": "Detector DetectorState",
        "detect.disturbance": "Disturbance DisturbanceState fit_disturbance",
        "detect.promise": "FalseAlarmTest Promise false_alarms",
        "detect.scores": "ConformalScores fit_scores resolution",
        "detect.slack": "Slack effective_samples",
        "detect.validity": "Validity ValidityState",
        "live.explanations": "Explanations",
        "live.gate": "Gate",
        "live.live": "Live",
        "live.machine": "AssetStatus Counts Received Recent",
        "models.cause": "Cause find_causes possible_causes",
        "models.fitting": "fit_monitor",
        "models.monitor": "Monitor",
        "models.trajectory.monitor": "TrajectoryMonitor fit_trajectory_monitor",
        "models.visibility": "visible_sizes",
        "models.state": "Alarm MonitorState Visible Watched",
        "models.trajectory.state": "TrajectoryAlarm TrajectoryState WatchedTrajectories",
        "store.audit": "Audit Entry export_log read_log verify",
        "store.samples": "Asset Committed Samples Trajectory Update",
        "store.store": "Store",
        "versions.comparison": "compare",
        "versions.decision": "Decision decide",
        "versions.recalibration": "recalibrate",
        "versions.registry": "Registry Version",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
