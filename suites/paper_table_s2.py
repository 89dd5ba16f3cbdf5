"""The experiments of the paper's Table S2 with the shipped files, as in `bench reproduce tableS2`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("tableS2")
