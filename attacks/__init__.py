"""Built-in attacks, one file each; `inversion` holds the network that paints images."""
