"""The experiments of the paper's Table 2 with the shipped files, as in `bench reproduce table2`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("table2")
