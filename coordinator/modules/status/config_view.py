"""``printer.configfile``: ``config`` has every option as text, ``settings`` as what it was read as."""

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any, Final

_NAMES: Final = ("config", "settings", "save_config_pending", "save_config_pending_items", "warnings")


class ConfigView(Mapping[str, Any]):
    """Options by section: CONFIG as text, SETTINGS as values and defaults. PENDING: for SAVE_CONFIG."""

    def __init__(
        self,
        config: Mapping[str, Mapping[str, str]],
        settings: Mapping[str, Mapping[str, object]],
        pending: Mapping[str, object],
    ) -> None:
        self._config = config
        self._settings = settings
        self._pending = pending

    def __getitem__(self, name: str) -> object:
        if name == "config":
            return {section: dict(options) for section, options in self._config.items()}
        if name == "settings":
            return {section.lower(): self._values(section) for section in self._config}
        if name == "save_config_pending":
            return bool(self._pending.get(name, False))
        if name == "save_config_pending_items":
            return self._pending.get(name, {})
        if name == "warnings":
            return []
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_NAMES)

    def __len__(self) -> int:
        return len(_NAMES)

    def _values(self, section: str) -> dict[str, object]:
        """Return values and defaults; what no reader knows stands as what it looks like."""
        given = {option: _typed(section, option, text) for option, text in self._config[section].items()}
        used = {option: _plain(value) for option, value in self._settings.get(section, {}).items()}
        return given | {option: value for option, value in used.items() if value is not None}


def _plain(value: object) -> object:
    """Return VALUE of what macros know; None: it is nothing for them."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        items = [_plain(item) for item in value]
        return None if None in items else items
    return None


_LISTS: Final = frozenset(
    (
        *("mesh_min", "mesh_max", "mesh_origin", "probe_count", "mesh_pps", "zero_reference_position"),
        *("gantry_corners", "points", "z_positions", "nozzle_xy_position", "switch_xy_position"),
        *("bed_xy_position", "probe_points", "chips", "axes_map", "initial_red", "homing_position"),
        *(f"screw{number}" for number in range(1, 10)),
        *(f"faulty_region_{number}_{end}" for number in range(1, 100) for end in ("min", "max")),
    )
)
"""Options of sections without a module that are lists of numbers, or of such lists over several lines."""


def _typed(section: str, option: str, text: str) -> object:
    """Return the value of an option that no reader knows, as the peer's users know it."""
    if section.startswith("gcode_macro ") or option not in _LISTS:
        return _guess(text)
    lines = [[_guess(word) for word in line.split(",")] for line in text.split("\n") if line.strip()]
    found: object = lines[0] if len(lines) == 1 else lines
    if option == "probe_count" and isinstance(found, list) and len(found) == 1:
        return found * 2
    return found


def _guess(text: str) -> object:
    """Return the value that TEXT looks like: a number, a truth value, else the text."""
    word = text.strip()
    if word.lower() in ("true", "yes", "on"):
        return True
    if word.lower() in ("false", "no", "off"):
        return False
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return text
