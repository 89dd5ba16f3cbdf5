"""Readers and writers of file formats of other programs."""
