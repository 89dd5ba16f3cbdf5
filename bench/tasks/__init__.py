"""Tasks: measures of releases and of attacks on them, one file each."""
