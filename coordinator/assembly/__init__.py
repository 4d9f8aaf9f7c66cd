"""Puts a machine together: loads a configuration whole, checks it, and prints the reference of its options."""
