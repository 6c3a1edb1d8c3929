"""Training of an approximator on what the camera saw."""
