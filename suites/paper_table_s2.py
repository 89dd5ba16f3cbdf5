"""The cells of the paper's Table S2, at the sizes of this distribution: those of `bench reproduce tableS2`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("tableS2")
