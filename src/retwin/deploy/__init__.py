"""Fitted models and large simulations outside this process.

Belongs here: bundles, exports, results of an identification, and simulations of any size into Zarr
folders. Not here: fitting.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "actuator.export": "ExportedActuator export_actuator",
        "actuator.torque_net": "ExportedActuatorNet Joint export_actuator_net",
        "bundle.bundle": "Bundle",
        "bundle.guard": "Guard fit_guard",
        "bundle.verdicts": "Domain Prediction Verdicts",
        "fmu.export": "ExportedFMU export_fmu",
        "identified": "save_identification",
        "onnx.export": "export_onnx",
        "onnx.portable": "Portable",
        "simulations": "Simulated SimulationPlan simulate_to",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
