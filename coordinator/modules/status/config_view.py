"""``printer.configfile``: ``config`` has every option as text, ``settings`` as what it was read as."""

import re
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Final

from coordinator.modules.status.lazy_status import LazyStatus
from nodes.support.numbers import read_decimal


def config_view(
    config: Mapping[str, Mapping[str, str]],
    settings: Mapping[str, Mapping[str, object]],
    pending: Mapping[str, object],
    warnings: Iterable[Mapping[str, str]] = (),
) -> LazyStatus:
    """Return options by section: CONFIG as text, SETTINGS as values and defaults; PENDING; WARNINGS."""
    return LazyStatus(
        config=lambda: {section: dict(options) for section, options in config.items()},
        settings=lambda: {
            section.lower(): _values(section, options, settings.get(section, {}))
            for section, options in config.items()
        },
        save_config_pending=lambda: bool(pending.get("save_config_pending", False)),
        save_config_pending_items=lambda: pending.get("save_config_pending_items", {}),
        warnings=lambda: [dict(warning) for warning in warnings],
    )


def config_warnings(unsupported: Iterable[object], notes: Iterable[str]) -> list[dict[str, str]]:
    """Return what does not act (UNSUPPORTED), and NOTES, as ``warnings``."""
    return [
        *({"type": "unsupported", "message": str(found)} for found in unsupported),
        *({"type": "note", "message": note} for note in notes),
    ]


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


_COUNTS: Final = frozenset(("probe_count", "mesh_pps"))
_WHOLE_NUMBERS: Final = re.compile(
    r"\w*(count|samples|retries|microsteps|_steps|_pps|_ppr|_address|_len)|x_count|y_count|driver_\w+|chain_\w+"
    r"|baud|full_steps_per_rotation|spi_speed|i2c_speed|rate|version|contrast|menu_timeout|idle_current_percent"
    r"|encoder_steps_per_detent|oversample_\w+|iir_filter"
)
"""Options without a reader of their own whose numbers are whole; all others are decimal numbers."""
_LISTS: Final = _COUNTS | frozenset(
    (
        *("mesh_min", "mesh_max", "mesh_origin", "zero_reference_position"),
        *("gantry_corners", "points", "z_positions", "nozzle_xy_position", "switch_xy_position"),
        *("bed_xy_position", "probe_points", "homing_position", "home_xy_position", "calibration_position"),
        *("dock_position", "approach_position", "detach_position", "extract_position", "insert_position"),
        *(f"screw{number}" for number in range(1, 100)),
        *(f"screw{number}_fine_adjust" for number in range(1, 100)),
        *(f"faulty_region_{number}_{end}" for number in range(1, 100) for end in ("min", "max")),
    )
)
"""Options without a reader of their own that are lists of numbers, or of such lists over several lines."""
_WORDS: Final = frozenset(("axes_map", "chips", "heaters", "steppers", "color_order"))
"""Such ones that are lists of words."""
_TEXTS: Final = re.compile(r".*_pin|pin|.*_name|name|i2c_bus|spi_bus|cs_pin|.*gcode|serial|description")
"""Such ones that are text, whatever it looks like."""
_WHOLE: Final = re.compile(r"[+-]?\d{1,18}", re.ASCII)


def _typed(section: str, option: str, text: str) -> object:
    """Return the value of an option that no reader knows, as the peer's users know it."""
    if section.startswith("gcode_macro ") or _TEXTS.fullmatch(option):
        return text
    if option in _WORDS:
        return [word.strip() for word in text.split(",") if word.strip()]
    if option not in _LISTS:
        return _guess(text, whole=_WHOLE_NUMBERS.fullmatch(option) is not None)
    number = _whole if option in _COUNTS else _decimal
    lines = [[number(word) for word in line.split(",")] for line in text.split("\n") if line.strip()]
    found: object = lines[0] if len(lines) == 1 else lines
    if option == "probe_count" and isinstance(found, list) and len(found) == 1:
        return found * 2
    return found


def _decimal(text: str) -> object:
    """Return the number TEXT, else the text."""
    value = read_decimal(text.strip())
    return text if value is None else value


def _whole(text: str) -> object:
    """Return the whole number TEXT, else the decimal number, else the text."""
    return int(text) if _WHOLE.fullmatch(text.strip()) else _decimal(text)


def _guess(text: str, *, whole: bool) -> object:
    """Return the value that TEXT looks like: a number, WHOLE if it can be, a truth value, else the text."""
    word = text.strip()
    if word.lower() in ("true", "yes", "on"):
        return True
    if word.lower() in ("false", "no", "off"):
        return False
    return _whole(text) if whole else _decimal(text)
