"""Plain text tables."""
