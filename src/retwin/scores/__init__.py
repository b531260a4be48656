"""Pure functions of arrays that score predictions and simulations.

Belongs here: every number that a page or a command shows and that needs no model. Not here:
anything that runs a twin or a network (see `evaluation`), or draws.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "bootstrap": "Draws Resampling bootstrap_means",
        "calibration": "Reliability calibration_error calibration_floor reliability",
        "change": "ErrorChange error_change",
        "classification": "Scores confusion row_shares score weighted_score",
        "comparison": "compare_runs holm no_verdict outcome",
        "decisions": "Cost Decision certain_decision decide healthy_needed",
        "distributions": "central_band crps cumulative_counts further_group_quantile "
        "grouped_quantile inside ks_distance log_score pit_histograms quantiles share_as_far",
        "energy": "energy_score",
        "histograms": "Histogram common_histogram",
        "intervals": "grouped_share_interval jackknife_interval share_interval",
        "residuals": "Binned Correlogram autocorrelation cross_correlation decorrelated_after "
        "error_by_amplitude ljung_box rms_over_time spectra",
        "roc": "Roc micro_roc",
        "segments": "SegmentError clearest_segment median_error_trajectory",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
