"""The commands of `bench`, one file each, found by their files' names.

A command's module has SUMMARY, EPILOG where there are examples to show, REQUIRED (the options that must be given), `options`,
which declares its options, and `execute`, which does it and returns the exit status. Heavy libraries are imported by `execute`.
"""
