"""What a release is judged by."""
