"""Extractors, one file each, and dictionaries of descriptors."""
