"""The commands of `hololoop-trainer`: what each is for, its options, what it does, and how it shows what it
found.

A command does its work and returns one object of plain values, which `--json` prints. Without `--json` the
command shows that same object to a person. What is heavy to import is imported when a command runs.
"""
