"""Dictionaries and databases of descriptors: construction, loading, quantisation."""
