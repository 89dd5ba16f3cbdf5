"""Extractors, one file each, which sets `PLUGIN`."""
