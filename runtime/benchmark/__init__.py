"""What the solver does on this machine: `hololoop-runtime benchmark`."""
