"""Networks in ONNX on the headset: the session that runs them, and the aberration approximator D."""
