"""The cells of the paper's Table 2, at the sizes of this distribution: those of `bench reproduce table2`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("table2")
