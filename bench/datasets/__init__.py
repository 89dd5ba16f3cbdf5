"""Datasets, one file each, which sets `PLUGIN`."""
