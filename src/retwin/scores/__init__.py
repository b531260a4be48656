"""Pure functions of arrays that score predictions and simulations.

Belongs here: every number that a page or a command shows and that needs no model. Not here:
anything that runs a twin or a network (see `evaluation`), or draws.
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Binned": "residuals",
    "Correlogram": "residuals",
    "Cost": "decisions",
    "Decision": "decisions",
    "Draws": "bootstrap",
    "ErrorChange": "change",
    "Histogram": "histograms",
    "Reliability": "calibration",
    "Resampling": "bootstrap",
    "Roc": "roc",
    "Scores": "classification",
    "SegmentError": "segments",
    "autocorrelation": "residuals",
    "bootstrap_means": "bootstrap",
    "calibration_error": "calibration",
    "calibration_floor": "calibration",
    "central_band": "distributions",
    "certain_decision": "decisions",
    "clearest_segment": "segments",
    "common_histogram": "histograms",
    "compare_runs": "comparison",
    "compliance": "comparison",
    "confusion": "classification",
    "cross_correlation": "residuals",
    "crps": "distributions",
    "cumulative_counts": "distributions",
    "decide": "decisions",
    "decorrelated_after": "residuals",
    "detection_difference": "decisions",
    "energy_score": "energy",
    "error_by_amplitude": "residuals",
    "error_change": "change",
    "further_group_quantile": "distributions",
    "grouped_quantile": "distributions",
    "grouped_share_interval": "intervals",
    "healthy_needed": "decisions",
    "holm": "comparison",
    "inside": "distributions",
    "jackknife_interval": "intervals",
    "ks_distance": "distributions",
    "ljung_box": "residuals",
    "log_score": "distributions",
    "median_error_trajectory": "segments",
    "micro_roc": "roc",
    "no_verdict": "comparison",
    "outcome": "comparison",
    "pit_histograms": "distributions",
    "quantiles": "distributions",
    "reliability": "calibration",
    "rms_over_time": "residuals",
    "row_shares": "classification",
    "score": "classification",
    "share_as_far": "distributions",
    "share_interval": "intervals",
    "spectra": "residuals",
    "weighted_score": "classification",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
