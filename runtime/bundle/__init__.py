"""The bundle: the folder in which a calibrated light path goes from the trainer to the headset."""
