"""Everything a person sees, made from records alone."""
