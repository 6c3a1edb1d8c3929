"""The command layer of both programs: commands, options, what is printed, exit codes.

It needs the standard library alone; rich is imported when something is shown.
"""
