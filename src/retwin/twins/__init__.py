"""Twins: commands in, outputs out."""
