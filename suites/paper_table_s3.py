"""The experiments of the paper's Table S3 with the shipped files, as in `bench reproduce tableS3`."""

from leaderboard.reproduce.suites import build_suite

SUITE = build_suite("tableS3")
