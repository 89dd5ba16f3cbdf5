"""The network that paints a photograph from a release: encoding, architecture, loss, data, training, weights."""
