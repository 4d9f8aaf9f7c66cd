"""A virtual bus with faults, and socketcand clients on it."""
