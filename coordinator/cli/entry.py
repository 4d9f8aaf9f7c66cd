"""The entry point of the command: Ctrl-C ends it at once until there is a job to cancel."""

import signal

# Not where Ctrl-C is ignored, as for what a shell runs in the background.
_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _interruptible:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> int:
    """Import the command line and run it; while it is imported, Ctrl-C must not print a traceback."""
    from coordinator.cli.main import main as run  # noqa: PLC0415 (the lines above come first)

    if _interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()
