"""One engine of the protocol, fed by hand, byte by byte."""

from typing import Any

from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import ACK, SOH, STX, write_block
from coordinator.dnc.protocol.engine import Engine, State


class Bench:
    """One engine, fed by hand; time passes by ``wait`` alone."""

    def __init__(self, *, peripheral: bool, start_s: float = 0.0, **options: Any) -> None:
        self.options = DncOptions(**({"baud": 9600} | options))
        self.now_s = start_s
        self.engine = Engine(self.options, start_s, peripheral=peripheral)
        self.events: list[events.Event] = []

    def wait(self, seconds: float) -> bytes:
        until_s = self.now_s + seconds
        while (due_s := self.engine.next_deadline()) is not None and due_s <= until_s:
            self.now_s = max(self.now_s, due_s)
            self.engine.handle_timer(self.now_s)
        self.now_s = until_s
        return self.said()

    def come(self, data: bytes, then_s: float = 0.05) -> bytes:
        """DATA comes over the line, and silence THEN_S long."""
        self.now_s += len(data) * self.options.character_time_s
        self.engine.receive(data, self.now_s)
        return self.wait(then_s)

    def said(self) -> bytes:
        self.events += self.engine.take_events()
        return self.engine.take_output()

    def happened(self) -> list[events.Event]:
        self.said()
        happened, self.events = self.events, []
        return happened

    def failure(self) -> str:
        (event,) = self.happened()
        assert isinstance(event, events.Failed)
        return event.sentence


def block(text: bytes, dc1: bool = True) -> bytes:
    return write_block(STX, text + b"\r\n", dc1=dc1)


def receiving(*, mode: str = "A", **options: Any) -> Bench:
    """An engine that waits for the first block: of a control's output, or of an input it asked for."""
    bench = Bench(peripheral=mode == "A", **options)
    if mode == "A":
        assert bench.come(write_block(SOH, b"DPARTA", dc1=True)) == b""
        bench.engine.accept()
        bench.happened()
        assert bench.said() == b""
    else:
        bench.engine.fetch("D", "PART")
        bench.said()
        bench.wait(0.1)
        bench.come(bytes([ACK]))
    assert bench.engine.state is State.RECEIVING
    return bench


def sending(**options: Any) -> Bench:
    """A control whose first line is on its way."""
    bench = Bench(peripheral=False, **options)
    bench.engine.send("D", "PART")
    bench.said()
    bench.wait(0.1)
    bench.come(bytes([ACK]))
    assert bench.happened() == [events.LineWanted()]
    bench.engine.give_line(b"X1")
    assert bench.said() == block(b"X1")
    bench.wait(0.1)
    return bench


def take(bench: Bench) -> bytes:
    (event,) = bench.happened()
    assert isinstance(event, events.Line)
    bench.engine.line_taken()
    assert bench.said() == bytes([ACK])
    return event.text
