"""The devices of a headset, opened by name."""
