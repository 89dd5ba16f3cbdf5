"""Registry of plugins: discovery, specifications as text, fields, and templates for new plugins."""
