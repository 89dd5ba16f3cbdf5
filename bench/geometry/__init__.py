"""Nearest words, affine subspaces and their intersections: pure functions of arrays."""
