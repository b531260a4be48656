"""Bundles: corrected twin, diagnoser and guard in one sealed folder.

`bundle.py` needs torch; `retwin.deploy.onnx.portable` predicts from a bundle's ONNX export with
onnxruntime, numpy, scipy, pydantic and threadpoolctl. Nothing is imported here, so that the latter
loads no torch.
"""
