"""Suites of experiments. Each file sets `SUITE`, and `bench sweep` finds it by file name."""
