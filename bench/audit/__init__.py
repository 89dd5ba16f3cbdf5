"""Audit of a defense's ε, by trials and by enumeration."""
