"""Stepper drivers: enable pins and TMC chips."""
