"""The light path from the panel to the image plane, for NumPy and torch, and the parts that it is made of."""
