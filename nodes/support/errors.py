"""The base of all errors that are reported to users."""


class CanductorError(Exception):
    """A failure described in one sentence: what went wrong, where, and what to do about it.

    The command line prints the sentence and exits with status 1; any other exception is a bug.
    Subclasses exist where a caller must distinguish failures.
    """
