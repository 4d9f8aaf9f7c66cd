"""The entry point of the command: Ctrl-C ends it at once until there is a job to cancel."""

import signal
import sys

# Not where Ctrl-C is ignored, as for what a shell runs in the background.
_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _interruptible:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> int:
    """Import the command line and run it; while it is imported, Ctrl-C must not print a traceback."""
    if sys.argv[1:2] == ["run"]:
        from coordinator.support.without_openssl import import_without_openssl  # noqa: PLC0415 (likewise)

        import_without_openssl()
    from coordinator.cli.main import main as run  # noqa: PLC0415 (the lines above come first)

    if _interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()
