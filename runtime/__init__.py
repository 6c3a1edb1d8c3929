"""The headset's side: it reads a calibrated light path and computes, by each frame's deadline, the pattern
that shows the picture best through it. It needs only the base install, never torch or the trainer."""
