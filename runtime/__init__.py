"""The headset's side of a holographic display: phase holograms by a deadline, through a calibrated light path.

It reads a bundle, computes for each picture the pattern that shows it best on the spatial light modulator (phase
retrieval), runs the display service, and corrects what drifts. It needs only the base install, never torch or the
trainer. runtime/README.md is its guide.
"""
