"""Fits of models to captures: Gauss-Newton, free-form maps, and where independent fits run."""
