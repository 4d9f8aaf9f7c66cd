"""What the command line hands to the parts that do the work, and what it expects back.

Imports nothing that is slow: ``canductor plan`` is measured from its first instruction.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from nodes.support.errors import CanductorError


def _examples() -> Path:
    """Return the folder of the example machines: inside an installed package, or config/ of a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "example_machines"
    return installed if installed.is_dir() else package.parent / "config"


EXAMPLES = _examples()
"""The example machines."""
DEMO_MACHINE = EXAMPLES / "demo" / "machine.cfg"
DEMO_GCODE = EXAMPLES / "demo" / "part.gcode"


class Terminated(KeyboardInterrupt):
    """SIGTERM ended a command, as Ctrl-C does."""


class Report(Protocol):
    """What a command hands back: shown as text, or as one JSON object on the last line."""

    @property
    def ok(self) -> bool:
        """Whether the command reached what it is for; decides about the exit status."""

    def to_json(self) -> Mapping[str, object]:
        """Return figures by name, made of what JSON knows; "ok" is added by the command line."""

    def to_text(self) -> str:
        """Return the same for a reader; when not ok it says what failed and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """How a machine is served to front ends."""

    name: str
    """What front ends show; also the socket's name unless PATH says otherwise."""
    path: Path | None = None
    """The Unix socket; None: NAME.sock where this user's machines have theirs."""
    jobs: Path | None = None
    """Folder of the files that may be printed; None: there are no jobs."""
    node_commands: bool = False
    """Whether clients may send raw commands to nodes."""
    tcp: tuple[str, int] | None = None
    """Host and port."""
    tokens: Path | None = None
    certificate: Path | None = None
    private_key: Path | None = None
    plain_on_loopback: bool = False
    web: tuple[str, int] | None = None
    """Address and port of the live page."""
    web_without_tls: bool = False
    """Serve the page without TLS beyond loopback, too."""
    web_names: tuple[str, ...] = ()
    """Host names, in lower case, that the page answers to."""
    announce: bool | None = None
    """Announce the machine on the network; None: if its TCP port can be reached from there."""
    metrics: tuple[str, int] | None = None
    """IP address and port of the figures for Prometheus."""
    config: Path = Path()
    """The configuration file, for clients that show where it is."""
    klippy_api: Path | None = None
    """The Unix socket for Moonraker (docs/klippy-api.md); None: there is none."""
    metrics_open: bool = False
    """Whether others than this computer may read them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """``canductor demo``."""

    machine: Path = DEMO_MACHINE
    """Configuration file whose nodes are played by virtual ones."""
    gcode: Path | None = None
    """None: the demo's own part."""
    json: bool = False
    """Only machine-readable output: no progress display."""
    web: bool = True
    """Serve the live page where that is installed."""
    loss: float = 0.0
    """Share of frames the virtual bus loses, 0 <= loss <= 0.5."""
    seed: int = 1
    """Decides which frames are lost."""
    rate_ppm: Mapping[str, float] = field(default_factory=dict)
    """By node: how much faster its clock runs than nominal."""
    start_clock: Mapping[str, int] = field(default_factory=dict)
    """By node: ticks its clock shows when the node starts."""
    cold: bool = False
    """The heaters begin cold; else as warm as some minutes after a print."""
    serve: ServeOptions | None = None
    """Serve the virtual machine to front ends instead of printing."""
    keep: Path | None = None
    """Folder that keeps step logs and captures; None: they are removed at the end."""
    socketcan: Mapping[str, str] = field(default_factory=dict)
    """By CAN bus of the configuration: the SocketCAN interface that carries it, instead of a virtual bus.
    Under the empty name: what carries those not named."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """``canductor run``."""

    config: Path
    gcode: Path | None = None
    """Printed once the machine is ready; None: commands come from elsewhere."""
    json: bool = False
    serve: ServeOptions | None = None
    """Serve the machine to front ends; None: print GCODE, or what comes on standard input, and end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """``canductor plan``."""

    config: Path
    gcode: Path
    """``-``: standard input."""
    output: Path | None = None
    """Folder for each node's command stream, the report and its plot; None: only the report."""
    plot: Path | None = None
    """SVG of velocity, flow and bus load."""
    can_bitrate: int = 1_000_000
    """Bit/s of every CAN bus."""
    json: bool = False
    dictionaries: Mapping[str, Path] = field(default_factory=dict)
    """By node: its data dictionary as JSON; other nodes take the project's own firmware."""
    tables: Mapping[str, Path] = field(default_factory=dict)
    """By axis: its compensation table, a CSV or a COMP_FILE of type 0 in mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """``canductor simulate``."""

    scenarios: tuple[str, ...] = ()
    """Names or files, each run with every seed; none: all, and several seeds are spread over them."""
    seeds: range = range(1, 2)
    jobs: int = 0
    """Processes; 0: as many as there are processors."""
    list: bool = False
    """Only name the scenarios."""
    json: bool = False


def find_machine(name: str) -> Path:
    """Return the configuration file of a path or of an example's name; raises CanductorError."""
    path = Path(name)
    try:
        if path.is_file():
            return path
        examples = {machine_name(p): p for p in sorted(EXAMPLES.rglob("*.cfg"))}
    except (OSError, ValueError):  # a name too long, or with a NUL
        examples = {}
    if name in examples:
        return examples[name]
    known = f"; examples are {', '.join(examples)}" if examples else ""
    raise CanductorError(f"there is no machine '{name}': neither a file nor an example{known}")


def machine_name(path: Path) -> str:
    """Return a machine's name: ``demo`` for demo/machine.cfg, and the file's stem for all others."""
    return path.parent.name if path.stem == "machine" else path.stem
