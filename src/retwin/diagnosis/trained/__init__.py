"""Diagnosers that are trained on labelled trajectories: networks, features and a linear model."""
