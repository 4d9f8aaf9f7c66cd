"""Nodes and buses without hardware."""
