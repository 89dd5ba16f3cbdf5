"""Numerical kernels that several plugins share: pure functions of arrays."""
