"""The method: surrogate (Eq. 5), corrections g, residual models (Eq. 6-10), identification.

Belongs here: everything that makes a corrected twin from a twin and measured outputs. Not
here: diagnosers, scores, and systems.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "agreement": "check_with_twin",
        "blackbox": "BlackBox fit_black_box",
        "corrected": "CorrectedTwin generate",
        "corrections": "Additive Chain CommandSpace Context Correction DelayOffset Discrepancy "
        "Head SampledSensor command_space fit_correction measured_outputs sample_mask",
        "device": "DeviceTwin Records",
        "dynamics": "Curve Dynamics DynamicsTwin FittedDynamics Library Prediction TanhNetwork "
        "fit_dynamics",
        "forecast_errors": "ForecastErrors",
        "forecasts": "free_moments",
        "identification": "Evolution LeastSquares MCMC NPE Noise Optimum Posterior PosteriorTwin "
        "Profile Updated calibration_ranks identify profile",
        "loading": "load_twin",
        "residual": "Density Flow Mixture Refinement Residual ResidualModel SequenceMixture "
        "SequenceResidual StationaryNoise fit_residual infer_discrepancy load_residual",
        "state_surrogate": "FittedStateSurrogate StateSurrogate fit_state_surrogate",
        "surrogate": "Surrogate fit_surrogate",
        "training_range": "OutsideTrainingWarning",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
