"""Structure from motion of releases: selection and verification of matches, and COLMAP's mapping."""
