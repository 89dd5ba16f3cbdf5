"""Localization from released features: a map of the references, retrieval, matching, and the pose of the query."""
