"""The data of the monitor: messages, each node's rates and the current load. Sans-IO."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.protocol.protocol import owner_of
from canbus_tools.protocol.traffic import NodeTraffic
from nodes.dictionary.dictionary import Dictionary

HISTORY: Final = 120
"""Number of loads that are kept."""
SPAN_S: Final = 2.0
"""Rates are averaged over this time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorOptions:
    """What to show of which bus."""

    bus: BusOptions
    bitrate: int
    """Bit rate to calculate the load with."""
    bitrate_is_known: bool
    filter_text: str = ""
    dictionaries: Mapping[int, Dictionary]
    fetch: tuple[str, ...] = ()
    lines: bool = True
    as_json: bool = False
    duration_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeRates:
    """One node, and its traffic per second over the last SPAN_S."""

    node: NodeTraffic
    messages_to: float
    messages_from: float
    bytes_to: float
    bytes_from: float
    load: float
    """Share of the bus used by its frames, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusRates:
    """The bus over the last SPAN_S."""

    load: float
    """0..1"""
    frames_per_s: float
    nodes: tuple[NodeRates, ...]
    """By node id."""


class _Totals:
    """Counters at one time; rates are differences of them."""

    def __init__(self, now_s: float, watch: "BusWatch") -> None:
        self.now_s = now_s
        self.frames = watch.frames
        self.bits = watch.bits
        self.nodes = {
            nodeid: (
                node.to_node.messages,
                node.from_node.messages,
                node.to_node.bytes,
                node.from_node.bytes,
                watch.node_bits.get(nodeid, 0),
            )
            for nodeid, node in watch.decoder.nodes.items()
        }


_NOTHING: Final = (0, 0, 0, 0, 0)


class BusWatch:
    """Evaluates the frames of a bus. Call ``update`` regularly, also without frames."""

    def __init__(self, decoder: BusDecoder, meter: LoadMeter, now_s: float) -> None:
        self.decoder = decoder
        self.meter = meter
        self.frames = 0
        self.bits = 0
        self.node_bits: dict[int, int] = {}
        self.loads: deque[float] = deque(maxlen=HISTORY)
        """Load of the bus between updates, the latest last."""
        self._moments: deque[_Totals] = deque([_Totals(now_s, self)])

    def feed(self, frame: Frame) -> Sequence[Decoded]:
        """Take the next frame and return what it contained."""
        bits = self.meter.feed(frame)
        self.frames += 1
        self.bits += bits
        owner = owner_of(frame.can_id) if frame.kind is FrameKind.DATA else None
        if owner is not None:
            self.node_bits[owner[0]] = self.node_bits.get(owner[0], 0) + bits
        return self.decoder.feed(frame)

    def update(self, now_s: float) -> BusRates:
        """Return the rates until NOW_S, of a monotonic clock."""
        latest = _Totals(now_s, self)
        before = self._moments[-1]
        passed_s = now_s - before.now_s
        if passed_s > 0:
            self.loads.append((latest.bits - before.bits) / (passed_s * self.meter.bitrate))
            self._moments.append(latest)
        while len(self._moments) > 2 and now_s - self._moments[1].now_s >= SPAN_S:
            self._moments.popleft()
        return self._rates(self._moments[0], latest)

    def _rates(self, old: _Totals, new: _Totals) -> BusRates:
        span_s = max(new.now_s - old.now_s, 1e-3)
        nodes = []
        for nodeid in sorted(new.nodes):
            pairs = zip(new.nodes[nodeid], old.nodes.get(nodeid, _NOTHING), strict=True)
            to, from_, bytes_to, bytes_from, bits = ((after - before) / span_s for after, before in pairs)
            nodes.append(
                NodeRates(
                    node=self.decoder.nodes[nodeid],
                    messages_to=to,
                    messages_from=from_,
                    bytes_to=bytes_to,
                    bytes_from=bytes_from,
                    load=bits / self.meter.bitrate,
                )
            )
        return BusRates(
            load=(new.bits - old.bits) / (span_s * self.meter.bitrate),
            frames_per_s=(new.frames - old.frames) / span_s,
            nodes=tuple(nodes),
        )
