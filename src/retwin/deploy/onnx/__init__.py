"""The ONNX export of a bundle, and its use without torch."""
