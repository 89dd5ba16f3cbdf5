"""Rendering of flat textured surfaces, from cameras with exact poses."""
