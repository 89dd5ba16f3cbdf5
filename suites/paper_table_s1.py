"""The experiments of the paper's Table S1 with the shipped files, as in `bench reproduce tableS1`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("tableS1")
