"""Helpers for all packages: errors, option values, files with secrets, charts, the C wire codec."""
