"""Finding a height: by hand, by probes."""
