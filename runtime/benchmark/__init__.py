"""The measurement of the solver on this machine: `hololoop-runtime benchmark`."""
