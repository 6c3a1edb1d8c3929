"""Self-calibration: a headset finds out with its own camera what has drifted since its bundle was exported."""
