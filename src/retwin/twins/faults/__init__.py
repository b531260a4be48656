"""Faults of actuators, sensors and parameters, and how they are applied to trajectories.

Belongs here: what a fault changes, and by how much. Not here: its diagnosis (see `diagnosis`).
"""
