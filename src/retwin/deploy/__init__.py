"""Fitted models and large simulations outside this process.

Belongs here: bundles, exports, results of an identification, and simulations of any size into Zarr
folders. Not here: fitting.
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Bundle": "bundle.bundle",
    "Domain": "bundle.verdicts",
    "ExportedActuator": "actuator.export",
    "ExportedActuatorNet": "actuator.torque_net",
    "ExportedFMU": "fmu.export",
    "Guard": "bundle.guard",
    "Joint": "actuator.torque_net",
    "Portable": "onnx.portable",
    "Prediction": "bundle.verdicts",
    "Simulated": "simulations",
    "SimulationPlan": "simulations",
    "Verdicts": "bundle.verdicts",
    "export_actuator": "actuator.export",
    "export_actuator_net": "actuator.torque_net",
    "export_fmu": "fmu.export",
    "export_onnx": "onnx.export",
    "fit_guard": "bundle.guard",
    "save_identification": "identified",
    "simulate_to": "simulations",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
