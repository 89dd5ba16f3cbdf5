"""Plugins: discovery, specs as text, fields, and templates for new plugins."""
