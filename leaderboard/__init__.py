"""Statistics, tables, plots and pages, from records alone."""
