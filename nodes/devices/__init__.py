"""What a node carries, as the host drives it."""
