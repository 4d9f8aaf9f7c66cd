"""The protocol itself, sans-IO: bytes and time in, bytes out, events to the caller."""
