"""The cells of the paper's Table 4, at the sizes of this distribution: those of `bench reproduce table4`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("table4")
