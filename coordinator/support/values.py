"""Plain values, as messages and statuses carry them."""

from typing import Any

Value = None | bool | int | float | str | list[Any] | dict[str, Any]
"""Lists and maps hold the same again; map keys are strings."""
