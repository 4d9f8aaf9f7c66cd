"""From G-code moves to compressed step commands."""
