"""Networks in ONNX on the headset."""
