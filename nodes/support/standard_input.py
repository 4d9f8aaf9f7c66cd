"""Standard input, where there is one."""

import sys
from typing import TextIO

from nodes.support.errors import CanductorError


def standard_input() -> TextIO:
    """Return it; raises CanductorError where the program was started without."""
    given: TextIO | None = sys.stdin
    if given is None:
        raise CanductorError("standard input is closed, so there is nothing to read; name a file")
    return given
