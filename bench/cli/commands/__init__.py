"""The commands of `bench`: one file each, found by file name.

A command has SUMMARY, REQUIRED (names of required options), optionally EPILOG (examples), `add_options`, and `execute`. The
function `execute` imports heavy libraries and returns the exit status.
"""
