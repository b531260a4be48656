"""Correction operators g: how a discrepancy z changes nominal outputs, and how z is inferred."""

from __future__ import annotations

from retwin.update.corrections.additive import Additive
from retwin.update.corrections.chain import (
    Chain,
    before_sensor,
    fit_correction,
    measured_outputs,
    measuring,
    sample_mask,
    sensor_of,
)
from retwin.update.corrections.commands.command_space import CommandSpace
from retwin.update.corrections.correction import Context, Correction, Discrepancy, Head
from retwin.update.corrections.delay_offset import DelayOffset
from retwin.update.corrections.sampled_sensor import SampledSensor

__all__ = [
    "Additive",
    "Chain",
    "CommandSpace",
    "Context",
    "Correction",
    "DelayOffset",
    "Discrepancy",
    "Head",
    "SampledSensor",
    "before_sensor",
    "command_space",
    "fit_correction",
    "measured_outputs",
    "measuring",
    "sample_mask",
    "sensor_of",
]


def command_space() -> Chain:
    """`CommandSpace` behind a `SampledSensor`, both with their default settings."""
    return Chain(CommandSpace(), SampledSensor())
