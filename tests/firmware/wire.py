"""Several simulated nodes on one CAN bus which carries a frame to all others in a fixed time."""

from collections.abc import Sequence
from dataclasses import dataclass

from tests.firmware.host import Host


@dataclass(frozen=True)
class Signal:
    """A frame with an id below 0x100, and when (in ticks since the wire was laid) it was sent, by whom."""

    at: int
    sender: int
    can_id: int
    data: bytes


class Wire:
    """Carries the signals of HOSTS, whose clocks run at one rate. Data stays between a node and its host."""

    def __init__(self, hosts: Sequence[Host], latency: int) -> None:
        self.hosts = hosts
        self.latency = latency
        self.now = 0
        self.heard: list[Signal] = []
        self._delivered = 0
        self._origins = [host.now for host in hosts]

    def run(self, ticks: int) -> None:
        """Let TICKS pass, from event to event."""
        end = self.now + ticks
        self._collect()  # what the test itself made them say
        while self.now < end:
            deadlines = [
                (host.node.next_deadline() or end) - origin
                for host, origin in zip(self.hosts, self._origins, strict=True)
            ]
            arrivals = [signal.at + self.latency for signal in self.heard[self._delivered :]]
            self.now = max(self.now, min([end, *deadlines, *arrivals]))
            for host, origin in zip(self.hosts, self._origins, strict=True):
                host.node.run_until(origin + self.now)
            self._deliver()
            self._collect()

    def _deliver(self) -> None:
        while self._delivered < len(self.heard):
            signal = self.heard[self._delivered]
            if signal.at + self.latency > self.now:
                break
            self._delivered += 1
            for number, host in enumerate(self.hosts):
                if number != signal.sender:
                    host.node.receive_frame(signal.can_id, signal.data)

    def _collect(self) -> None:
        for number, host in enumerate(self.hosts):
            host.receive()
            self.heard += [Signal(self.now, number, *frame) for frame in host.signals]
            host.signals.clear()

    def local(self, number: int, at: int) -> int:
        """Return the clock, 32 bits, of node NUMBER at time AT."""
        return (self._origins[number] + at) & 0xFFFFFFFF
