"""Structure from motion from releases: selection and verification of matches, and COLMAP's mapping."""
