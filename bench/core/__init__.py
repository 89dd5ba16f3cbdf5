"""Errors, exact numbers, hashes, devices, threads, randomness, progress and the environment. The lowest layer."""
