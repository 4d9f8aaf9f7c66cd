"""The machine service: its life, the feeder, the work of clients."""
