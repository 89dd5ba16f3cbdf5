"""Plugins: discovery, specs written as text, fields, the listing, templates for new ones."""
