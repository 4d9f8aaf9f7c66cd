# ruff: noqa: RUF009 (option() declares a field, as dataclasses.field does)
"""Scenarios: what is simulated, what goes wrong in it, and what has to come of it. docs/simulation.md."""

import difflib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.support.quoting import shown
from coordinator.support.toml_values import (
    Range,
    ScenarioError,
    choice,
    flag,
    number,
    option,
    patterns,
    read,
    span,
    text,
    whole,
)
from nodes.support.errors import CanductorError
from nodes.support.file_kind import is_regular

SCENARIOS: Final = Path(__file__).parent / "scenarios"
MACHINES: Final = Path(__file__).parent / "machines"
MAX_FILE_BYTES: Final = 200_000
MAX_FAULTS: Final = 50
DAY_S: Final = 86_400.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSetting:
    """How one node is; what is not said is as on a sound board."""

    ppm: Range = option(span(-1000, 1000, "ppm"), Range(-80, 80))
    """How much faster its clock runs than nominal."""
    ramp_ppm_per_s: Range = option(span(-20, 20, "ppm/s"), Range(0, 0))
    """How its clock's rate changes with temperature."""
    ramp_s: Range = option(span(0, 100, "s"), Range(5, 5))
    """How long the change lasts."""
    rollover_after_s: Range = option(span(0, DAY_S, "s"), Range(0, 20))
    """When its 32-bit clock rolls over, counted from the beginning."""
    clock_hz: int = option(whole(1_000_000, 600_000_000), 0)
    """Its clock's nominal frequency; 0: as the firmware was built."""
    latency_us: Range = option(span(0, 5000, "µs"), Range(0, 40))
    """How late it comes to read what it has received, at most."""
    move_slots: int = option(whole(16, 4096), 0)
    """Size of its move queue; 0: as the firmware was built."""
    legacy: bool = option(flag, default=False)
    """A board of the older kind: without group triggers and sync pulse."""
    power_on_s: Range = option(span(0, 60, "s"), Range(0, 0))
    """When it gets power."""
    boot_s: Range = option(span(0.001, 60, "s"), Range(0.002, 0.002))
    """From power or reset to its firmware's start: the time of a boot loader, which is deaf."""
    config_reset: str = option(choice("clears", "restarts", "unknown"), "clears")
    """What this command does; ``reset`` is known to all and restarts the board."""
    same_uuid_as: str = option(text, "")
    """A double of that node: made by mistake with the same uuid."""
    uuid: str = option(text, "")
    """Of a node that is on the bus but not in the configuration: its own uuid, 12 hex digits."""
    bus: str = option(text, "")
    """Likewise: the interface it is attached to."""
    has_id: int = option(whole(1, 255), 0)
    """Likewise: the node id that another host gave it; 0: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusSetting:
    """How one wire is: a CAN interface or the device file of a UART."""

    bitrate: int = option(whole(10_000, 8_000_000), 1_000_000)
    """bit/s."""
    loss: Range = option(span(0, 0.5), Range(0, 0))
    """Share of frames (UART: of bytes) that vanish."""
    corruption: Range = option(span(0, 0.2), Range(0, 0))
    """Share of frames (UART: of bytes) that arrive with a flipped bit that no CRC of CAN sees."""
    errors: Range = option(span(0, 0.5), Range(0, 0))
    """Share of frames that a bit error turns into an error frame."""
    queue_frames: int = option(whole(1, 1000), 0)
    """Room in the transmit queue of the host's adapter; 0: as on Linux by default."""
    delay_us: Range = option(span(0, 10_000, "µs"), Range(0, 60))
    """How late the host reads what arrived, at most."""
    noise_bytes: Range = option(span(0, 500), Range(0, 0))
    """UART: garbage that stands on the line when it is opened."""
    usb_of: str = option(text, "")
    """The node that the device is on, by USB: it disappears when the node is reset or loses its power."""
    usb_gone_s: Range = option(span(0, 60, "s"), Range(0.8, 0.8))
    """How long after the reset or the power it comes back."""
    dtr: bool = option(flag, default=False)
    """UART: its node is reset when DTR rises, as when the device is opened."""
    load: Range = option(span(0, 1.5), Range(0, 0))
    """Other traffic, as a share of the bus."""
    load_id: int = option(whole(0, 0x7FC), 0x7E0)
    """The first of its four CAN ids; by default it gives way to all else, 260 goes before all nodes' data."""


FAULT_KINDS: Final = {
    "cut": "the node's cable is off",
    "reset": "the node restarts",
    "power": "the node has no power, and starts again after it",
    "stall": "the node, or the host, does nothing",
    "babble": "the node sends frames without end",
    "forge": "the node's controller sends one frame with the id and the content of others",
    "block": "the node's controller sends a sound block with the number that the receiver expects",
    "lie": "the node answers by a clock that is wrong; its timers stay right",
    "flood": "foreign bytes are on the UART in both directions, among what is sent",
    "loss": "a share of the bus's frames vanishes",
    "corruption": "a share of the bus's frames changes without anybody noticing",
    "errors": "a share of the bus's frames becomes error frames; all of them: who sends goes bus-off",
    "interrupt": "the user presses Ctrl-C",
    "sensor": "the wires of the node's temperature sensors are open; the scenario needs a plant",
}
_OF_A_NODE: Final = frozenset(FAULT_KINDS) - {"loss", "corruption", "errors", "interrupt", "flood"}
HOST: Final = "host"


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultSetting:
    """One thing that goes wrong."""

    kind: str = option(choice(*FAULT_KINDS))
    """What: see below."""
    at_s: Range = option(span(0, 100, "s"))
    """When, counted from ``since``."""
    for_s: Range = option(span(0, 100, "s"), Range(0, 0))
    """How long."""
    since: str = option(choice("start", "job"), "job")
    """The start of the connection, or the begin of the job on the connected machine."""
    node: str = option(text, "")
    """Which node, or ``host``."""
    bus: str = option(text, "")
    """Which wire."""
    share: Range = option(span(0, 1), Range(0, 0))
    """How much of the bus's frames; afterwards there are no such faults on it, whatever its setting says."""
    id: int = option(whole(0, 0x7FF), 0x700)
    """``babble``, ``forge``, ``block``: the CAN id that is sent."""
    data: str = option(text, "")
    """``forge``: the frame's content; ``block``: the commands in it; ``flood``: what is repeated, or nothing
    for random bytes. At most 8 bytes as hexadecimal digits."""
    wrong_s: Range = option(span(-100, 100, "s"), Range(0, 0))
    """``lie``: how far the clock it answers with is from its own."""
    random_s: Range = option(span(0, 100, "s"), Range(0, 0))
    """``lie``: up to so much more, other in every answer."""
    times: Range = option(span(1, 50), Range(1, 1))
    """How often it happens."""
    every_s: Range = option(span(0.01, 60, "s"), Range(1, 1))
    """From one begin to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputSetting:
    """What is right for one output of a node that is no stepper's."""

    node: str = option(text)
    """Its node."""
    pin: str = option(text)
    """Its pin, as the board calls it."""
    stopped: int = option(whole(0, 1), 0)
    """The level that it has to have ``stop_s`` after a stop that reaches its node, and keeps."""
    cold_s: float = option(number(0, 10, "s"), 0.0)
    """Of a heater: so long after a ``sensor`` fault of its node it has to be off, until that ends; 0: it is
    not looked at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What is printed: lines of the scenario, or strokes made from the seed."""

    lines: str = option(text, "")
    """The g-code itself; the seed decides nothing then."""
    strokes: Range = option(span(1, 2000), Range(8, 20))
    """How many pieces (a line, a curve of short segments, a zigzag, a hop, a pause …) are put together."""
    speed_mm_s: Range = option(span(1, 500, "mm/s"), Range(60, 250))
    """The fastest of them; the slowest takes a tenth."""
    size_mm: float = option(number(0.5, 200, "mm"), 8.0)
    """The square in which they lie."""
    long_s: Range = option(span(0, 60, "s"), Range(0, 0))
    """Adds moves to and fro that take about so long."""
    fan: float = option(number(0, 1), 0.0)
    """The share of lines that are followed by another speed of the fan."""
    begin: str = option(text, "")
    """Lines in front of all that."""
    end: str = option(text, "")
    """Lines behind all that."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """Bounds, in addition to what always has to hold."""

    clock_error_us: float = option(number(0, 2000, "µs"), 8.0)
    """How far a secondary node's clock may be from print time, in truth, while it steps."""
    late_us: float = option(number(0, 2000, "µs"), 0.0)
    """Deviation that the scenario allows every step in addition."""
    stop_s: float = option(number(0, 10, "s"), 0.1)
    """How long after a stop the last node that can be reached may still step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Head:
    about: str = option(text)
    machine: str = option(text, "pair")
    expect: str = option(choice("completes", "may_stop", "stops"), "completes")
    causes: tuple[str, ...] = option(patterns, ())
    weight: float = option(number(0, 20), 1.0)
    plant: bool = option(flag, default=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A scenario file, read."""

    name: str
    given: str
    """As the command line names it: a name, or the path of a file of the user's own."""
    about: str
    """One sentence: what it is about."""
    machine: Path
    """Its configuration."""
    expect: str
    """``completes``, ``may_stop`` (completes, or stops for one of the causes) or ``stops``."""
    causes: tuple[str, ...]
    """Regular expressions; the sentence of a stop must contain one."""
    weight: float
    """Its share of the seeds, relative to others with 1; 0: only when it is named."""
    plant: bool = False
    """Whether there is something to heat and to measure at the boards' pins."""
    nodes: Mapping[str, NodeSetting] = field(default_factory=dict)
    """By name; those not named are as NodeSetting is by default. Names that the configuration does not have
    are nodes the host does not know of."""
    buses: Mapping[str, BusSetting] = field(default_factory=dict)
    """By interface or device file."""
    program: Program = field(default_factory=Program)
    faults: tuple[FaultSetting, ...] = ()
    outputs: Mapping[str, OutputSetting] = field(default_factory=dict)
    """By a name of the scenario's own."""
    bounds: Bounds = field(default_factory=Bounds)


_TABLES: Final = ("nodes", "buses", "program", "faults", "outputs", "bounds")


def load(path: Path) -> Scenario:
    """Read a scenario file; raises ScenarioError, one sentence, for the first mistake found."""
    where = path.name
    values = _parse(path)
    head_values = {name: value for name, value in values.items() if name not in _TABLES}
    for name in head_values:
        if name not in _Head.__slots__ and difflib.get_close_matches(name, _TABLES):
            raise ScenarioError(
                f"{where}: there is no table {shown(name)}; "
                f"did you mean [{difflib.get_close_matches(name, _TABLES)[0]}]?"
            )
    head = read(_Head, head_values, where)
    scenario = Scenario(
        name=path.stem,
        given=path.stem if path.parent == SCENARIOS else str(path),
        about=head.about,
        machine=_machine(head.machine, path),
        expect=head.expect,
        causes=head.causes,
        weight=head.weight,
        plant=head.plant,
        nodes=_named(NodeSetting, values, "nodes", where),
        buses=_named(BusSetting, values, "buses", where),
        program=read(Program, values.get("program", {}), f"{where}: [program]"),
        faults=_faults(values.get("faults", []), where),
        outputs=_named(OutputSetting, values, "outputs", where),
        bounds=read(Bounds, values.get("bounds", {}), f"{where}: [bounds]"),
    )
    if not scenario.plant and any(fault.kind == "sensor" for fault in scenario.faults):
        raise ScenarioError(f"{where}: a fault of kind sensor needs plant = true")
    if bool(scenario.causes) == (scenario.expect == "completes"):
        rule = "needs causes" if scenario.expect != "completes" else "takes no causes"
        raise ScenarioError(f"{where}: expect is '{scenario.expect}' and {rule}")
    return scenario


def _parse(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ScenarioError(f"{path}: larger than {MAX_FILE_BYTES} bytes; is this a scenario?")
        return tomllib.loads(data.decode("utf-8"))
    except OSError as error:
        raise ScenarioError(f"cannot read the scenario '{path}': {error.strerror}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ScenarioError(f"{path}: this is not TOML: {error}") from None


def _machine(name: str, scenario: Path) -> Path:
    for path in (MACHINES / f"{name}.cfg", scenario.parent / name):
        try:
            if is_regular(path):
                return path
        except CanductorError as error:
            raise ScenarioError(f"{scenario.name}: the machine {error}") from None
    known = sorted(path.stem for path in MACHINES.glob("*.cfg"))
    raise ScenarioError(
        f"{scenario.name}: there is no machine {shown(name)}: neither a file in the scenario's folder "
        f"nor one of {', '.join(known)}"
    )


def _named(kind: type[Any], values: Mapping[str, Any], table: str, where: str) -> dict[str, Any]:
    entries = values.get(table, {})
    if not isinstance(entries, Mapping):
        raise ScenarioError(f"{where}: [{table}] must be a table of tables, such as [{table}.NAME]")
    return {name: read(kind, entry, f"{where}: [{table}.{name}]") for name, entry in entries.items()}


def _faults(entries: object, where: str) -> tuple[FaultSetting, ...]:
    if not isinstance(entries, list):
        raise ScenarioError(f"{where}: faults must be written as [[faults]]")
    if len(entries) > MAX_FAULTS:
        raise ScenarioError(f"{where}: {len(entries)} faults; {MAX_FAULTS} is the most")
    faults = [read(FaultSetting, e, f"{where}: [[faults]] number {i}") for i, e in enumerate(entries, 1)]
    for number_, fault in enumerate(faults, 1):
        on_bus = fault.kind in ("loss", "corruption", "errors", "flood")
        if not _is_content(fault.data):
            raise ScenarioError(
                f"{where}: [[faults]] number {number_}: data must be 0..8 bytes in hexadecimal, "
                f"not {shown(fault.data)}"
            )
        missing = "bus" if on_bus and not fault.bus else "node" if _needs_node(fault) else ""
        if missing:
            raise ScenarioError(f"{where}: [[faults]] number {number_}: kind {fault.kind} needs a {missing}")
    return tuple(faults)


def _is_content(text_: str) -> bool:
    return re.fullmatch(r"([0-9a-f]{2}){0,8}", text_) is not None


def _needs_node(fault: FaultSetting) -> bool:
    return not fault.node and fault.kind in _OF_A_NODE


# ---------------------------------------------------------------------------------------------- finding


def names() -> list[str]:
    """Return the names of the scenarios that come with the project."""
    return sorted(path.stem for path in SCENARIOS.glob("*.toml"))


def find(name: str) -> Scenario:
    """Return the scenario of that name or file; raises ScenarioError."""
    built_in = SCENARIOS / f"{name}.toml"
    if name in names():
        return load(built_in)
    path = Path(name)
    if path.suffix == ".toml":
        return load(path)
    close = difflib.get_close_matches(name, names(), n=1, cutoff=0.5)
    hint = f"did you mean {close[0]}?" if close else "canductor simulate --list names them"
    raise ScenarioError(f"there is no scenario {shown(name)}; {hint}")
