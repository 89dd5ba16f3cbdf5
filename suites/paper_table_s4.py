"""The cells of the paper's Table S4, at the sizes of this distribution: those of `bench reproduce tableS4`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("tableS4")
