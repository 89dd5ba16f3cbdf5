"""Photographs, their views, scenes, and the samples that records are about."""
