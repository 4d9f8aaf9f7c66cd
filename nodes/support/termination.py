"""Signals that end a program as Ctrl-C does."""

import signal
from typing import Final

TERMINATION: Final = (signal.SIGTERM, signal.SIGHUP)
"""SIGHUP: its terminal is gone."""
