"""Tools on a live or virtual CAN bus."""
