"""The experiments of the paper's Table 1 with the shipped files, as in `bench reproduce table1`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("table1")
