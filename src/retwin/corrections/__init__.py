"""Correction operators g: how a discrepancy z changes nominal outputs, and how z is inferred."""

from __future__ import annotations

from retwin.corrections.command_space import CommandSpace
from retwin.corrections.delay_offset import DelayOffset
from retwin.corrections.protocol import Context, Correction, Discrepancy, Head

__all__ = [
    "OPERATORS",
    "CommandSpace",
    "Context",
    "Correction",
    "DelayOffset",
    "Discrepancy",
    "Head",
]

OPERATORS: tuple[type, ...] = (DelayOffset, CommandSpace)
"""Those that a model folder may name."""
