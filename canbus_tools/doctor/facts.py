"""What the doctor knows, before it judges."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from canbus_tools.bus.bus_load import BusLoad
from canbus_tools.bus.link_facts import LinkFacts
from canbus_tools.discovery.inventory import Inventory


@dataclass(frozen=True, slots=True, kw_only=True)
class AdapterFacts:
    """What drives the interface."""

    kernel: str = ""
    """As ``uname -r`` says."""
    driver: str = ""
    usb_id: tuple[int, int] | None = None
    usb_name: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class InterfaceFacts:
    """A SocketCAN interface."""

    name: str
    link: LinkFacts | None
    """None: there is none."""
    others: tuple[str, ...] = ()
    """CAN interfaces that there are."""
    adapter: AdapterFacts = AdapterFacts()


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionFacts:
    """What was observed of one node; blocks are the protocol's."""

    nodeid: int
    to_blocks: int
    invalid_bytes: int
    """That the node sent and that made no block here."""
    repeated_blocks: int
    naks: int
    rtt_median_s: float | None = None
    rtt_p99_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficFacts:
    """What was heard."""

    listened_s: float
    load: BusLoad | None = None
    """None: the bit rate is not known."""
    frames: int = 0
    """Good ones, of anybody but this program."""
    other_frames: int = 0
    """Of these, not of this protocol."""
    error_reports: int = 0
    errors: Mapping[str, int] = field(default_factory=dict)
    """Error reports by what they say: ack, form, stuff, bit, overflow, bus off, other."""
    nodes: tuple[DirectionFacts, ...] = ()
    send_queue_full: bool = False
    """A few short frames did not fit into the send queue (ENOBUFS)."""
    before: LinkFacts | None = None
    after: LinkFacts | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PingFacts:
    """Questions put to one node, and how that went."""

    nodeid: int
    asked: int
    repeats: int
    """Blocks that the link had to send again."""
    lost: int
    """Time-outs without a late answer: a slow computer repeats blocks, too, and then hears two answers."""
    invalid_bytes: int
    rtt_median_s: float
    rtt_p99_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeFacts:
    """Who is there."""

    inventory: Inventory
    pings: tuple[PingFacts, ...] = ()
    silenced: Mapping[int, str] = field(default_factory=dict)
    """Nodes that said what they are and then answered no more: what went wrong, in a sentence."""
    heard_at: Mapping[int, int] = field(default_factory=dict)
    """Frames heard by bit rate, where other bit rates were tried."""
