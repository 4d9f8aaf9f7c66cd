"""Devices that a node carries, as the host configures and uses them."""
