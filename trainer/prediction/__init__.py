"""Predicted camera counts: the four stages of light, scenes of one colour and plane, and the light path."""
