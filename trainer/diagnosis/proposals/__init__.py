"""Effect files that the captures accept, for what has no name: read off the stages' fitted probes."""
