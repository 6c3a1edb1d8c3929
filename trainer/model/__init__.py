"""A model of a bench: its effects and their values, its file, its text, and its export to the headset."""
