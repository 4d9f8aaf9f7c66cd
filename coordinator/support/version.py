"""The project's version, which packaging reads here, too."""

from typing import Final

VERSION: Final = "0.1.0"
"""As semver.org numbers them."""
