"""Identification of a photograph from its reconstruction."""
