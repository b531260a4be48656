"""Twins from MJCF and URDF models, simulated by MuJoCo.

Belongs here: what knows MuJoCo. Not here: the models of built-in systems (see `cases`).
"""
