"""Compiled kernels: the surrogate and its Jacobian, effective commands, delays and records.

Each does in one pass over a trajectory, in C and on all threads of torch, what the same function of
`retwin.update` does in torch with many passes over a set. The functions in torch stay: they give
gradients, serve where there is no C compiler, and are what the kernels are tested against.
"""
