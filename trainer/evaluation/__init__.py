"""Every method side by side on one virtual bench: `evaluate`."""
