"""Extractors: one file each, which assigns `PLUGIN`."""
