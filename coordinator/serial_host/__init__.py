"""A pseudo-terminal for hosts that speak G-code over a serial line, such as OctoPrint (docs/pty.md)."""
