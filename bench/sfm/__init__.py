"""Structure from motion of releases: which matches are kept, and what COLMAP makes of them."""
