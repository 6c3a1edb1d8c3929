"""Training of an approximator and of an initialiser: pairs to learn from, losses, metrics, and the training run."""
