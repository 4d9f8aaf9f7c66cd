"""``printer.configfile``: ``config`` has every option as text, ``settings`` as what it was read as."""

from collections.abc import Mapping
from enum import Enum
from typing import Final

from coordinator.modules.status.lazy_status import LazyStatus


def config_view(
    config: Mapping[str, Mapping[str, str]],
    settings: Mapping[str, Mapping[str, object]],
    pending: Mapping[str, object],
) -> LazyStatus:
    """Return options by section: CONFIG as text, SETTINGS as values and defaults; and what is PENDING."""
    return LazyStatus(
        config=lambda: {section: dict(options) for section, options in config.items()},
        settings=lambda: {
            section.lower(): _values(section, options, settings.get(section, {}))
            for section, options in config.items()
        },
        save_config_pending=lambda: bool(pending.get("save_config_pending", False)),
        save_config_pending_items=lambda: pending.get("save_config_pending_items", {}),
        warnings=list,
    )


def _values(section: str, texts: Mapping[str, str], values: Mapping[str, object]) -> dict[str, object]:
    """Return values and defaults; what no reader knows stands as what it looks like."""
    given = {option: _typed(section, option, text) for option, text in texts.items()}
    used = {option: _plain(value) for option, value in values.items()}
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
