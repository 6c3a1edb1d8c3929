"""Self-calibration: a headset measures with its own camera what has drifted since its bundle was exported."""
