"""Compensation tables of axes: read, checked, drawn, kept over restarts, and brought to the nodes."""
