"""Finding a height: by hand, later by probes."""
