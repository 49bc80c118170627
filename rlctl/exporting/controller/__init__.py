"""`rlctl export --controller`: from what a robot measures to joint targets within limits, as C and ONNX."""
