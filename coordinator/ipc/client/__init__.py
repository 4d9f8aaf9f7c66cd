"""The client for programs, with and without an event loop."""
