"""Where the command begins: until there is anything to stop in order, Ctrl-C just ends it."""

import gc
import signal

# Not where Ctrl-C is ignored, as it is for what a shell runs in the background.
_early = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _early:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> int:
    """Import the command line and run it."""
    gc.disable()  # what is imported stays
    from coordinator.cli.main import main as run  # noqa: PLC0415 (the lines above come first)

    if _early:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.freeze()
    gc.enable()
    return run()
