"""Suites, one file each, which sets `SUITE`; `bench sweep` finds them by file name."""
