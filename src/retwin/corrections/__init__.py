"""Correction operators g: how a discrepancy z changes nominal outputs, and how z is inferred."""

from __future__ import annotations

from retwin.corrections.additive import Additive
from retwin.corrections.chain import Chain, calibrated, readings, recorded
from retwin.corrections.command_space import CommandSpace
from retwin.corrections.delay_offset import DelayOffset
from retwin.corrections.protocol import Context, Correction, Discrepancy, Head
from retwin.corrections.sampled_sensor import SampledSensor

__all__ = [
    "NAMED_OPERATORS",
    "OPERATORS",
    "Additive",
    "Chain",
    "CommandSpace",
    "Context",
    "Correction",
    "DelayOffset",
    "Discrepancy",
    "Head",
    "SampledSensor",
    "calibrated",
    "readings",
    "recorded",
]

OPERATORS: tuple[type, ...] = (Additive, DelayOffset, CommandSpace, SampledSensor, Chain)
"""Those that a model folder may name."""
NAMED_OPERATORS: dict[str, Correction] = {
    "additive": Additive(),
    "delay_offset": DelayOffset(),
    "command_space": Chain(CommandSpace(), SampledSensor()),
}
"""Those that the command line knows by name."""
