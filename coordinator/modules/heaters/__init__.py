"""Heaters: control, tuning, safety, and the sections that have one."""
