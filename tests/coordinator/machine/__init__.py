"""The configuration file, its options and pins."""
