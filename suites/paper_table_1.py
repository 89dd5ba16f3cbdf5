"""The cells of the paper's Table 1, at the sizes of this distribution: those of `bench reproduce table1`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("table1")
