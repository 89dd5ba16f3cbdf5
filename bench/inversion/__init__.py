"""The network that reconstructs a photograph from a release: encoding, architecture, loss, data, training, weights."""
