"""The hardware-in-the-loop cycle: show, capture, learn, and show better (Chakravarthula et al. 2020, Algorithm 1)."""
