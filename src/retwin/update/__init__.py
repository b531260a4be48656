"""The method: surrogate (Eq. 5), corrections g, residual models (Eq. 6-10), identification.

Belongs here: everything that makes a corrected twin from a twin and measured outputs. Not
here: diagnosers, scores, and systems.
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Additive": "corrections",
    "BlackBox": "blackbox",
    "Chain": "corrections",
    "CommandSpace": "corrections",
    "Context": "corrections",
    "CorrectedTwin": "corrected",
    "Correction": "corrections",
    "Curve": "dynamics",
    "DelayOffset": "corrections",
    "Density": "residual",
    "Discrepancy": "corrections",
    "Dynamics": "dynamics",
    "DynamicsTwin": "dynamics",
    "Evolution": "identification",
    "FittedDynamics": "dynamics",
    "FittedStateSurrogate": "state_surrogate",
    "Flow": "residual",
    "Head": "corrections",
    "LeastSquares": "identification",
    "Library": "dynamics",
    "MCMC": "identification",
    "Mixture": "residual",
    "NPE": "identification",
    "Noise": "identification",
    "Optimum": "identification",
    "OutsideTrainingWarning": "training_range",
    "Posterior": "identification",
    "PosteriorTwin": "identification",
    "Prediction": "dynamics",
    "Profile": "identification",
    "Refinement": "residual",
    "Residual": "residual",
    "ResidualModel": "residual",
    "SampledSensor": "corrections",
    "SequenceMixture": "residual",
    "SequenceResidual": "residual",
    "StateSurrogate": "state_surrogate",
    "Surrogate": "surrogate",
    "TanhNetwork": "dynamics",
    "Updated": "identification",
    "calibration_ranks": "identification",
    "command_space": "corrections",
    "fit_black_box": "blackbox",
    "fit_correction": "corrections",
    "fit_dynamics": "dynamics",
    "fit_residual": "residual",
    "fit_state_surrogate": "state_surrogate",
    "fit_surrogate": "surrogate",
    "generate": "corrected",
    "identify": "identification",
    "infer_discrepancy": "residual",
    "load_residual": "residual",
    "measured_outputs": "corrections",
    "profile": "identification",
    "sample_mask": "corrections",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
