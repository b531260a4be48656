"""Validation of identified parameters: what the data determine, and the error before and after.

Belongs here: what is computed from a result of `rt.identify` and measured trajectories. Not here:
the search and the posterior (see `update.identification`).
"""
