"""The experiments of the paper's Table 4 with the shipped files, as in `bench reproduce table4`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("table4")
