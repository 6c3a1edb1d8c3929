"""The hardware-in-the-loop cycle: show, capture, learn, and show better (seed Algorithm 1)."""
