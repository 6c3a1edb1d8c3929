"""Reads capture sets, explains them, fits, trains and exports; offline, on a workstation."""
