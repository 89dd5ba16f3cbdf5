"""Results that are stored under the hash of what they were computed from."""
