"""The cells of the paper's Table S3, at the sizes of this distribution: those of `bench reproduce tableS3`."""

from leaderboard.reproduce.suites import of_table

SUITE = of_table("tableS3")
