"""The inference engine: latent discrepancies from measured outputs, for any differentiable model.

Belongs here: the solver, robust noise, priors, Laplace's evidence. Not here: what a discrepancy
does to outputs (see `update`) and what a fault implies (see `diagnosis`).
"""
