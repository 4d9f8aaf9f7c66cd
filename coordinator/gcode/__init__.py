"""G-code: lines, state and commands."""
