"""Versions of a twin: the registry that holds them, and which of two is better.

Belongs here: proposal, comparison, promotion and rollback. Not here: the calibration of a new
version (see `models`).
"""
