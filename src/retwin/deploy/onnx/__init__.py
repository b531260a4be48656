"""The ONNX export of a bundle: `export` writes it with torch, `portable` uses it without."""
