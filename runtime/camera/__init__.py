"""Where the camera looks and how it sees the image plane: registration, sampling, view."""
