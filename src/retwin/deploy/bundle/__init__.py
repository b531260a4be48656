"""Bundles: all that was fitted in one sealed folder, which knows where it may be trusted.

`bundle.py` is the whole with torch; `portable.py` predicts from its ONNX export on onnxruntime and
numpy alone. Nothing is imported here, so that the latter never waits for torch.
"""
