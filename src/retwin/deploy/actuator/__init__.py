"""Actuator models for robot learning, as TorchScript and ONNX.

Belongs here: what an actuator effectively executes, step by step for many environments at once. Not
here: whole twins, which are exported as FMUs (`retwin.deploy.fmu`) or bundles.
"""

from __future__ import annotations
