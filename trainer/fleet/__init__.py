"""Many headsets' capture sets in one run: a table of what is wrong with each, and what drifts together."""
