"""Twins from the equations of their states: the equations, their steps in time, and their files.

Belongs here: what a `StateTwin` is made of. Not here: compilation of steps (see `compiled`).
"""
