"""Fidelity: how well the distribution of a twin's outputs matches measured healthy trajectories."""
