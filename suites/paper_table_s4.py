"""The experiments of the paper's Table S4 with the shipped files, as in `bench reproduce tableS4`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("tableS4")
