"""Weighs the words of a set by the sets around it: what the attack `context` runs, and how it is trained."""
