"""Fitted models and large simulations outside this process.

Belongs here: bundles, exports, and simulations of any size into Zarr folders. Not here: fitting.
"""
