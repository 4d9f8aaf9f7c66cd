"""Folders of the user as the XDG Base Directory Specification has them."""

import os
from pathlib import Path

from nodes.support.errors import CanductorError


def user_folder(variable: str, *default: str) -> Path:
    """Return the folder that the environment's VARIABLE names, else DEFAULT in the user's home.

    Raises CanductorError when there is no home. A relative path in VARIABLE is ignored, as the specification
    requires.
    """
    given = os.environ.get(variable, "")
    if given.startswith("/"):
        return Path(given)
    try:
        return Path.home().joinpath(*default)
    except RuntimeError:
        raise CanductorError(f"this user has no home folder; set HOME or {variable}") from None
