"""A configured machine on virtual nodes, with the plant around their pins."""
