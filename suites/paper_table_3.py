"""The cells of the paper's Table 3, at the sizes of this distribution: those of `bench reproduce table3`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("table3")
