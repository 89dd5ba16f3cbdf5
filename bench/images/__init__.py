"""Photographs, their views, scenes, and the samples of a run."""
