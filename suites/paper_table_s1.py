"""The cells of the paper's Table S1, at the sizes of this distribution: those of `bench reproduce tableS1`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("tableS1")
