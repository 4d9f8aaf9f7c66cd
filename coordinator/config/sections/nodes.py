"""The sections [mcu] and [mcu NAME], [board_pins] and [duplicate_pin_override]."""

import re
from collections.abc import Iterable

from coordinator.config.errors import ConfigError, Place
from coordinator.config.file import ConfigFile, RawSection
from coordinator.config.model import (
    CanConnection,
    NodeDescription,
    NodePolicy,
    StepperDescription,
    UartConnection,
    Unsupported,
)
from coordinator.config.options import (
    BadValue,
    ChoiceOption,
    IntOption,
    ListOption,
    SectionReader,
    SectionSpec,
    TextOption,
)
from coordinator.config.pins import MULTI_PIN, PRIMARY_NODE, PinOption, PinRegistry
from coordinator.config.sections.probe import note_probe
from coordinator.config.sections.virtual_endstops import note_diag_pins
from coordinator.config.unsupported import UNSUPPORTED_MCU_OPTIONS
from coordinator.support.quoting import nearest, shown
from nodes.node.board_reset import ResetMethod

SERIAL = TextOption(
    name="serial",
    help="serial device of a node on a UART or on USB",
    pattern_rule="a path such as /dev/ttyACM0",
)
BAUD = IntOption(
    name="baud",
    help="speed of the serial line",
    default=250_000,
    unit="bit/s",
    minimum=2400,
    maximum=12_000_000,
)
CANBUS_UUID = TextOption(
    name="canbus_uuid",
    help="identity of a node on a CAN bus, as printed by a query of the bus",
    pattern="[0-9a-fA-F]{12}",
    pattern_rule="12 hex digits such as 11aa22bb33cc",
)
CANBUS_INTERFACE = TextOption(
    name="canbus_interface",
    help="the CAN bus: can0, virtual:PATH, or INTERFACE:CHANNEL as python-can names them",
    default="can0",
    pattern=r"[A-Za-z0-9_.-]{1,15}|[a-z0-9_-]+:\S+",
    pattern_rule="an interface such as can0, virtual:PATH or INTERFACE:CHANNEL",
)
RESTART_METHOD = ChoiceOption(
    name="restart_method",
    help="how the host resets the node: by the pulse of DTR that Arduinos need or Cheetah boards need, by the"
    " power of the USB ports, or by a command of the firmware, which is also tried where the others have no"
    " effect; by default arduino on a serial line, command on CAN",
    choices=("arduino", "cheetah", "rpi_usb", "command"),
)
POLICY = ChoiceOption(
    name="policy",
    help="what happens when the node is lost, shuts down or restarts: fatal stops the machine, pause lets the"
    " job wait until the node is back, optional goes on without it; a node with steppers is fatal",
    default=NodePolicy.FATAL.value,
    choices=tuple(policy.value for policy in NodePolicy),
)
MCU = SectionSpec(
    help="One micro-controller. [mcu] is the primary, [mcu NAME] another; each has 'serial' or 'canbus_uuid'",
    options=(SERIAL, BAUD, CANBUS_UUID, CANBUS_INTERFACE, RESTART_METHOD, POLICY),
    unsupported=UNSUPPORTED_MCU_OPTIONS,
)
BOARD_MCU = ListOption(name="mcu", help="the nodes that have these pins", default=(PRIMARY_NODE,))
ALIASES = ListOption(name="aliases", help="NAME=PIN pairs; NAME=<WORD> reserves a pin")
MORE_ALIASES = ListOption(name="aliases_", help="further NAME=PIN pairs, for one connector")
BOARD_PINS = SectionSpec(
    help="Second names for pins, as printed on a board", options=(BOARD_MCU, ALIASES), family=MORE_ALIASES
)
SHARED_PINS = ListOption(name="pins", help="pins that several options may use")
DUPLICATE_PIN_OVERRIDE = SectionSpec(help="Pins that are shared on purpose", options=(SHARED_PINS,))

_CHIP_PINS = {"adc_scaled": "", "ads1x1x": "", "ads1118": "", "sx1509": "sx1509_", "replicape": "replicape"}
"""Kinds of sections with pins of their own, and what stands in front of NAME where their pins are named."""
_NODE_NAME = re.compile(r"[A-Za-z0-9_.-]+", re.ASCII)


def read_nodes(config: ConfigFile, unsupported: list[Unsupported]) -> tuple[NodeDescription, ...]:
    """Return all nodes, the primary first; raises ConfigError."""
    if PRIMARY_NODE not in config.sections:
        raise ConfigError(
            Place(config.path, 0),
            "there is no section [mcu]; add it to say how to reach the main board",
        )
    sections = [section for section in config.sections.values() if section.kind == PRIMARY_NODE]
    sections.sort(key=lambda section: section.instance != "")
    nodes = tuple(_read_node(section, unsupported) for section in sections)
    _check_distinct(nodes)
    return nodes


def _read_node(section: RawSection, unsupported: list[Unsupported]) -> NodeDescription:
    name = section.instance or PRIMARY_NODE
    if section.instance == PRIMARY_NODE or not _NODE_NAME.fullmatch(name):
        raise ConfigError(section.place, f"{shown(name)} is not a name for a node; use letters, digits and _")
    reader = SectionReader(section, MCU)
    if reader.has(SERIAL) and reader.has(CANBUS_UUID):
        raise ConfigError(
            reader.place_of(CANBUS_UUID),
            f"[{section.name}] has both 'serial' and 'canbus_uuid'; keep one of them",
        )
    if reader.has(SERIAL):
        connection = _read_uart(reader)
    elif reader.has(CANBUS_UUID):
        connection = _read_can(reader)
    else:
        raise ConfigError(
            section.place,
            f"[{section.name}] does not say how to reach the node; add 'canbus_uuid' or 'serial'",
        )
    policy = _read_policy(reader)
    waiting = [option.name for option in reader.finish()]
    if waiting:
        unsupported.append(Unsupported(section.name, section.place, tuple(waiting)))
    return NodeDescription(name, connection, section.place, policy, reader.place_of(POLICY))


def _read_policy(reader: SectionReader) -> NodePolicy:
    policy = NodePolicy(reader.get(POLICY))
    if policy is not NodePolicy.FATAL and not reader.section.instance:
        raise reader.bad(POLICY, "but the primary node's clock is the time of all others; make it 'fatal'")
    return policy


def check_policies(nodes: Iterable[NodeDescription], steppers: Iterable[StepperDescription]) -> None:
    """Refuse a node that carries a stepper and may come and go; raises ConfigError."""
    carried = {stepper.node: stepper for stepper in reversed(tuple(steppers))}
    for node in nodes:
        if node.policy is not NodePolicy.FATAL and node.name in carried:
            raise ConfigError(
                node.policy_place,
                f"option '{POLICY.name}' of [{PRIMARY_NODE} {node.name}] is '{node.policy.value}', but the"
                f" node carries [{carried[node.name].name}], whose position would be lost; make it 'fatal'",
            )


def _read_uart(reader: SectionReader) -> CanConnection | UartConnection:
    restart = ResetMethod(reader.find(RESTART_METHOD) or "arduino")
    return UartConnection(reader.get(SERIAL), reader.get(BAUD), restart, reader.place_of(SERIAL))


def _read_can(reader: SectionReader) -> CanConnection | UartConnection:
    restart = reader.find(RESTART_METHOD)
    if restart not in (None, "command"):
        raise reader.bad(RESTART_METHOD, "but a node on CAN restarts by command only; remove it")
    uuid = reader.get(CANBUS_UUID).lower()
    return CanConnection(uuid, reader.get(CANBUS_INTERFACE), reader.place_of(CANBUS_UUID))


def _check_distinct(nodes: tuple[NodeDescription, ...]) -> None:
    """Refuse two nodes on CAN that claim to be the same board."""
    check_distinct(nodes, CanConnection)


def check_distinct(
    nodes: Iterable[NodeDescription], kind: type[CanConnection] | type[UartConnection]
) -> None:
    """Refuse two nodes with a connection of KIND that claim to be the same board; raises ConfigError.

    Serial lines are only compared before they are opened: published configurations have the same
    placeholder for all.
    """
    seen: dict[str, NodeDescription] = {}
    for node in nodes:
        connection = node.connection
        if not isinstance(connection, kind):
            continue
        key = connection.uuid if isinstance(connection, CanConnection) else connection.path
        other = seen.setdefault(key, node)
        if other is not node:
            raise ConfigError(
                connection.place,
                f"nodes '{other.name}' ({other.connection.place}) and '{node.name}' are both {shown(key)};"
                " each node needs its own",
            )


def make_pin_registry(config: ConfigFile, nodes: tuple[NodeDescription, ...]) -> PinRegistry:
    """Return the registry with the user's aliases and permissions to share; raises ConfigError."""
    names = tuple(node.name for node in nodes)
    registry = PinRegistry(names)
    for section in config.sections.values():
        if section.kind == "board_pins":
            _read_aliases(section, registry)
    for section in config.sections.values():
        if section.kind == "duplicate_pin_override":
            _read_shared(section, registry)
    note_diag_pins(config, registry)
    note_probe(config, registry)
    _note_chips(config, registry)
    return registry


def _note_chips(config: ConfigFile, registry: PinRegistry) -> None:
    """Register the sections whose pins other sections may name."""
    for section in config.sections.values():
        if section.kind == MULTI_PIN:
            registry.chips[MULTI_PIN] = section.name
            registry.multi_pins.add(section.instance)
        elif (prefix := _CHIP_PINS.get(section.kind)) is not None:
            registry.chips[f"{prefix}{section.instance}" or section.kind] = section.name


def _read_aliases(section: RawSection, registry: PinRegistry) -> None:
    # Users spread long tables over aliases_exp1, aliases_exp2, …
    tables = [
        ListOption(name=name, help=ALIASES.help, may_be_empty=True)
        for name in section.options
        if name == ALIASES.name or name.startswith(f"{ALIASES.name}_")
    ]
    reader = SectionReader(section, SectionSpec(BOARD_PINS.help, (BOARD_MCU, ALIASES, *tables)))
    boards = reader.get(BOARD_MCU)
    for node in boards:
        if node not in registry.nodes:
            raise reader.bad(BOARD_MCU, f"there is no node {shown(node)}{nearest(node, registry.nodes)}")
    for table in tables:
        for pair in reader.get(table):
            alias, equals, pin = (part.strip() for part in pair.partition("="))
            if not equals or not alias:
                raise reader.bad(table, f"{shown(pair)} is not NAME=PIN")
            for node in boards:
                registry.add_alias(node, alias, pin, section.options[table.name])
    reader.finish()


def _read_shared(section: RawSection, registry: PinRegistry) -> None:
    reader = SectionReader(section, DUPLICATE_PIN_OVERRIDE)
    pin = PinOption(name=SHARED_PINS.name, help=SHARED_PINS.help, pullable=True)
    for text in reader.get(SHARED_PINS):
        try:
            registry.allow_sharing(pin.parse(text))
        except BadValue:
            raise reader.bad(SHARED_PINS, f"{shown(text)} must be {pin.rule()}") from None
    reader.finish()
