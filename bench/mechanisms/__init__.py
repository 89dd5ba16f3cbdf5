"""Exact samplers of local differential privacy, composition, budgets, subset size, and `protect`."""
