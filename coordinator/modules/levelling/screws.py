"""The screws that a bed stands on, as [bed_screws] and [screws_tilt_adjust] name them."""

import re
from dataclasses import dataclass
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.file import RawOption
from coordinator.config.options import BadValue, FloatOption, TextOption
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.modules.base import Build
from coordinator.modules.levelling.surfaces import Place

SCREW: Final = TextOption(
    name="screw", help="X and Y of a screw: screw1, screw2, …; screw1_name and the like is what it is called"
)
_NUMBER: Final = re.compile(r"(\d{1,2})(_name|_fine_adjust)?", re.ASCII)
LEAST: Final = 3


@dataclass(frozen=True, slots=True)
class Screw:
    """One of them."""

    key: str
    """``screw1``."""
    name: str
    place: Place
    fine: Place | None
    """Where the nozzle goes to adjust it finely; None: nowhere."""


def read_screws(build: Build, *, own: tuple[str, ...], fine: bool) -> tuple[Screw, ...]:
    """Return the screws of a section in the order of their numbers; raises ConfigError.

    OWN: options of the section that only begin like a screw; FINE: whether screws may have a second place.
    """
    parts: dict[int, dict[str, RawOption]] = {}
    for rest, raw in build.reader.family().items():
        if raw.name in own:
            continue
        match = _NUMBER.fullmatch(rest)
        if match is None or (match[2] == "_fine_adjust" and not fine):
            raise ConfigError(raw.place, f"[{build.name}] has no option '{raw.name}'; remove it")
        parts.setdefault(int(match[1]), {})[match[2] or ""] = raw
    screws = tuple(_screw(build, number, found) for number, found in sorted(parts.items()))
    if len(screws) < LEAST:
        raise ConfigError(
            build.place, f"[{build.name}] has {len(screws)} screws; give {LEAST} or more: screw1, screw2, …"
        )
    return screws


def _screw(build: Build, number: int, found: dict[str, RawOption]) -> Screw:
    if "" not in found:
        raw = next(iter(found.values()))
        raise ConfigError(
            raw.place, f"'{raw.name}' of [{build.name}] refers to screw{number}, which is not configured"
        )
    place = _place(build, found[""])
    name = found["_name"].value if "_name" in found else f"screw at {place[0]:.3f},{place[1]:.3f}"
    fine = _place(build, found["_fine_adjust"]) if "_fine_adjust" in found else None
    return Screw(f"screw{number}", name, place, fine)


def _place(build: Build, raw: RawOption) -> Place:
    number = FloatOption(name="", help="", minimum=-MAX_POSITION, maximum=MAX_POSITION)
    words = [word.strip() for word in raw.value.split(",")]
    try:
        if len(words) == 2:
            return number.parse(words[0]), number.parse(words[1])
    except BadValue:
        pass
    raise ConfigError(
        raw.place,
        f"option '{raw.name}' of [{build.name}] must be X and Y in mm with a comma between them: 30, 30",
    )
