"""Corrections of a machine's geometry."""
