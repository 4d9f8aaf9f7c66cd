"""The commands that every machine has, apart from those that modules add."""
