"""The base of all errors that are reported to users."""

from nodes.support.terminal import printable_lines


class CanductorError(Exception):
    """A failure described in one sentence: what went wrong, where, and what to do about it.

    The command line prints the sentence and exits with status 1; any other exception is a bug.
    Subclasses exist where a caller must distinguish failures. The sentence may quote names from files,
    clients and wires: what a terminal would obey is replaced.
    """

    def __str__(self) -> str:
        """Return the sentence."""
        return printable_lines(super().__str__())
