"""Audits of ε: what a defense's releases show of it, by trials and by enumeration."""
