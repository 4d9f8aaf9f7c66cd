"""Making the machine itself straight: screws, Z motors, the geometry of a delta."""
