"""Errors, exact numbers, hashes, devices, threads, randomness, progress and the environment. Imports no other layer."""
