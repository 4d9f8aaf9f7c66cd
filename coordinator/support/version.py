"""The version of the installed project."""

from importlib import metadata


def version() -> str:
    """Return the version, such as 1.2.3, or "(not installed)"."""
    try:
        return metadata.version("canductor")
    except metadata.PackageNotFoundError:
        return "(not installed)"
