"""The light path from the panel to the image plane, for NumPy and torch alike, and what it is made of."""
