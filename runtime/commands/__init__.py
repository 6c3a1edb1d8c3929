"""The commands of `hololoop-runtime`: a file each, with its options, what it does, and what a person sees of it."""
