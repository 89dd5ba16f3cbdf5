"""Dictionaries and databases of descriptors: build, load, quantise."""
