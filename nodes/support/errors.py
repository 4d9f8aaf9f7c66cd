"""The one error type that reaches a user."""


class CanductorError(Exception):
    """A failure described in one sentence: what went wrong, where, and what to do about it.

    The command line prints the sentence and exits with status 1; everything else that escapes is a bug.
    Subclasses exist where a caller must distinguish failures.
    """
