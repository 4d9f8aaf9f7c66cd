"""Pins: how they are named, and that each is used once or shared on purpose.

A pin is ``[!][^|~][node:]name``, or with the marks after the node as in ``toolhead:!^PA3``. ``!`` inverts,
``^`` asks for a pull-up, ``~`` for a pull-down. Without a node the pin is one of the primary node, ``mcu``.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from coordinator.config.errors import ConfigError, NotSupported, Place
from coordinator.config.file import RawOption, RawSection
from coordinator.config.options import BadValue, Option
from coordinator.support.quoting import nearest, shown

PRIMARY_NODE = "mcu"
MULTI_PIN = "multi_pin"
_PIN = re.compile(r"([!^~ ]*)(?:([A-Za-z0-9_.-]+) *: *)?([!^~ ]*)([A-Za-z0-9_./-]+)", re.ASCII)
_MAX_PIN_CHARS = 100
_EXCLUSIVE = ""


@dataclass(frozen=True, slots=True)
class PinName:
    """A pin as written in an option."""

    node: str
    name: str
    invert: bool = False
    pull: int = 0
    """1 pull-up, -1 pull-down, 0 none."""
    sensor: str = ""
    """The section of the sensor that is meant: the name is no pin's."""


@dataclass(frozen=True, slots=True)
class PinDescription:
    """A pin with aliases resolved; whether the node has it only its dictionary knows: see ``number``."""

    node: str
    name: str
    invert: bool
    """The electrical level is the opposite of the logical one."""
    pull: int
    """1 pull-up, -1 pull-down, 0 none."""
    purpose: str
    """Which option it is for: "'step_pin' of [stepper_x]"."""
    place: Place
    sensor: str = ""
    """The section of the sensor that is meant: the name is no pin's."""

    def number(self, pins: Mapping[str, int]) -> int:
        """Return the pin's number in the node's dictionary; raises ConfigError when it has no such pin."""
        number = pins.get(self.name)
        if number is None:
            hint = nearest(self.name, pins) or "; see the board's documentation for its pins"
            raise ConfigError(
                self.place, f"{self.purpose}: node '{self.node}' has no pin {shown(self.name)}{hint}"
            )
        return number


@dataclass(frozen=True, slots=True)
class ProbeSwitch:
    """What an endstop_pin means that names the probe."""

    pin: PinName
    offset: tuple[float, float, float]
    """Of the probe from the nozzle, mm."""
    section: str
    """Its section: ``bltouch``."""


NO_PIN = PinName(PRIMARY_NODE, "")
"""Stands in for a pin after a mistake."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PinOption(Option[PinName]):
    """A pin."""

    invertible: bool = True
    pullable: bool = False
    """Whether ^ and ~ make sense: for inputs."""
    share: str = _EXCLUSIVE
    """Options with the same word here may name the same pin; empty: the pin is for this option alone."""

    def parse(self, text: str) -> PinName:
        """Return the parts of a pin's name."""
        match = _PIN.fullmatch(text) if len(text) <= _MAX_PIN_CHARS else None
        if match is None:
            raise BadValue
        marks = (match[1] + match[3]).replace(" ", "")
        if len(set(marks)) != len(marks) or ("^" in marks and "~" in marks):
            raise BadValue
        if "!" in marks and not self.invertible:
            raise BadValue("which cannot be inverted; remove the !")
        if ("^" in marks or "~" in marks) and not self.pullable:
            raise BadValue("which is an output; remove the ^ or ~")
        pull = ("^" in marks) - ("~" in marks)
        return PinName(match[2] or PRIMARY_NODE, match[4], "!" in marks, pull)

    def rule(self) -> str:
        """Return the values allowed."""
        marks = ("!" if self.invertible else "") + ("^~" if self.pullable else "")
        return "a pin as in PA3 or toolhead:PA3" + (f", may begin with {' or '.join(marks)}" if marks else "")

    def stand_in(self) -> PinName:
        """Return a pin that does not exist."""
        return NO_PIN

    def setting(self, text: str, value: PinName) -> object:
        """Return the pin as it is written."""
        del value
        return text


_ANY_PIN = PinOption(name="pin", help="any pin", pullable=True)


@dataclass(slots=True)
class PinRegistry:
    """Who uses which pin."""

    nodes: tuple[str, ...]
    _aliases: dict[tuple[str, str], str] = field(default_factory=dict)
    _shareable: set[tuple[str, str]] = field(default_factory=set)
    _users: dict[tuple[str, str], tuple[PinDescription, str]] = field(default_factory=dict)
    diag_pins: dict[str, PinName | None] = field(default_factory=dict)
    """Of the sections whose virtual endstop an endstop_pin may name, such as ``tmc2209_stepper_x``; None: it
    has no diag_pin."""
    chips: dict[str, str] = field(default_factory=dict)
    """Sections whose pins other sections may name, and that no module is for yet, by what stands in front of
    the colon: ``sx1509_duex`` is of ``sx1509 duex``."""
    multi_pins: set[str] = field(default_factory=set)
    """Names of the sections [multi_pin NAME], whose pins are all behind ``multi_pin:``."""
    probe: ProbeSwitch | None = None
    """The input of the probe, which ``probe:z_virtual_endstop`` stands for."""

    def copy(self) -> "PinRegistry":
        """Return an independent copy."""
        return PinRegistry(
            self.nodes,
            dict(self._aliases),
            set(self._shareable),
            dict(self._users),
            dict(self.diag_pins),
            self.chips,
            self.multi_pins,
            self.probe,
        )

    def add_alias(self, node: str, alias: str, name: str, option: RawOption) -> None:
        """Give a pin a second name ([board_pins]); a name in angle brackets reserves the alias instead."""
        if self._aliases.setdefault((node, alias), name) != name:
            raise ConfigError(
                option.place,
                f"alias {shown(alias)} of node '{node}' already means {shown(self._aliases[node, alias])}",
            )

    def allow_sharing(self, pin: PinName) -> None:
        """Allow several options to use one pin ([duplicate_pin_override])."""
        self._shareable.add((pin.node, self._aliases.get((pin.node, pin.name), pin.name)))

    def claim(self, pin: PinName, option: PinOption, section: RawSection) -> PinDescription:
        """Take a pin for an option; raises ConfigError for an unknown node or a pin in use."""
        place = section.options[option.name].place if option.name in section.options else section.place
        purpose = f"'{option.name}' of [{section.name}]"
        claimed = PinDescription(pin.node, pin.name, pin.invert, pin.pull, purpose, place, pin.sensor)
        if pin is NO_PIN:
            return claimed
        try:
            return self._claim(pin, claimed, option.share)
        except NotSupported:
            raise
        except ConfigError as error:
            section.report(error)
            section.stands_in = True
        return claimed

    def _claim(self, pin: PinName, wanted: PinDescription, share: str) -> PinDescription:
        if pin.node not in self.nodes:
            if pin.node in self.chips:
                raise NotSupported(wanted.place, self._of_chip(pin, wanted))
            hint = nearest(pin.node, self.nodes, pattern="'{}'") or f"; add a section [mcu {pin.node}]"
            raise ConfigError(wanted.place, f"{wanted.purpose}: there is no node {shown(pin.node)}{hint}")
        claimed = replace(wanted, name=self._resolve(pin, wanted.purpose, wanted.place))
        user, other_share = self._users.setdefault((pin.node, claimed.name), (claimed, share))
        if user is not claimed:
            self._check_shared(claimed, share, user, other_share)
        return claimed

    def _of_chip(self, pin: PinName, wanted: PinDescription) -> str:
        """Say what a pin is that is no node's; raises ConfigError for one that its section does not have."""
        section = self.chips[pin.node]
        if pin.node == MULTI_PIN:
            if pin.name not in self.multi_pins:
                hint = nearest(pin.name, self.multi_pins) or f"; add a section [{MULTI_PIN} {pin.name}]"
                raise ConfigError(
                    wanted.place, f"{wanted.purpose}: there is no [{MULTI_PIN} {pin.name}]{hint}"
                )
            section = f"{MULTI_PIN} {pin.name}"
        return f"{wanted.purpose} is a pin of [{section}], which is not supported yet"

    def claimed(self, node: str) -> list[str]:
        """Return the names of NODE's pins that are in use."""
        return [name for other, name in self._users if other == node]

    def check_unclaimed(self, options: Iterable[RawOption], section: str) -> None:
        """Raise ConfigError when a section that is not supported yet names a pin that is not to be shared.

        Pins it names wrongly are left to its module.
        """
        for option in options:
            if option.name != "pin" and not option.name.endswith("_pin"):
                continue
            try:
                pin = _ANY_PIN.parse(option.value)
            except BadValue:
                continue
            key = (pin.node, self._aliases.get((pin.node, pin.name), pin.name))
            user, share = self._users.get(key, (None, "anything"))
            if user is not None and share == _EXCLUSIVE and key not in self._shareable:
                raise _in_use(option.place, f"'{option.name}' of [{section}]", user)

    def _resolve(self, pin: PinName, purpose: str, place: Place) -> str:
        name = self._aliases.get((pin.node, pin.name), pin.name)
        if not name:
            raise ConfigError(place, f"{purpose}: alias {shown(pin.name)} of [board_pins] has no pin; add it")
        if name.startswith("<"):
            raise ConfigError(place, f"{purpose}: pin {shown(pin.name)} is reserved for {name}; use another")
        return name

    def _check_shared(self, new: PinDescription, new_share: str, user: PinDescription, share: str) -> None:
        if (new.node, new.name) in self._shareable:
            return
        if not new_share or new_share != share:
            raise _in_use(new.place, new.purpose, user)
        if (new.invert, new.pull) != (user.invert, user.pull):
            raise ConfigError(
                new.place,
                f"{new.purpose}: pin {new.node}:{new.name} is shared with {user.purpose} ({user.place})"
                " but has other marks (! ^ ~); make them the same",
            )


def _in_use(place: Place, purpose: str, user: PinDescription) -> ConfigError:
    pin = f"{user.node}:{user.name}"
    return ConfigError(place, f"{purpose}: pin {pin} is already used for {user.purpose} ({user.place})")
