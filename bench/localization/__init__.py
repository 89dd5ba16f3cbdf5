"""Localization from released features: map of the references, retrieval, matching, and pose of the query."""
