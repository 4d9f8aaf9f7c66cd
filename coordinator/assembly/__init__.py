"""Assembles a machine: loads a whole configuration, checks it, and prints the reference of its options."""
