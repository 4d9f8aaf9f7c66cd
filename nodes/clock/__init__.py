"""Time between host and nodes: clock estimates, sync pulses, time on the wire."""
