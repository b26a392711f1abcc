"""SDF networks from exact distances: training, and the certificate at its end."""
