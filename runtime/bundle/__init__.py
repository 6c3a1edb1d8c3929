"""The bundle: a calibrated light path as the trainer hands it to the headset."""
