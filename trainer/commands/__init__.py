"""The commands of `hololoop-trainer`: a file each, with its options, what it does, and what a person sees of it.

A command does its work and returns one object of plain values, which `--json` prints. Without `--json` the
command shows that same object to a person. What is heavy to import is imported when a command runs.
"""
