"""Capture sets: read, written, checked, taken on a bench, and split into fitted and held-out captures."""
