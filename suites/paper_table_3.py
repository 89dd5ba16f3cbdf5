"""The experiments of the paper's Table 3 with the shipped files, as in `bench reproduce table3`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("table3")
