"""The commands of `bench`, one file each, found by file name.

A command has SUMMARY, optionally EPILOG (examples), REQUIRED (names of required options), `add_options`, and `execute`, which
returns the exit status. `execute` imports heavy libraries.
"""
