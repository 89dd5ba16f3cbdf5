"""Statistics, tables, plots and pages, computed from records alone."""
