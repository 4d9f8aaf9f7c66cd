"""How much of a serial line's rate BCC uses: a file through two pseudo-terminals with a cable between.

The cable is a process of its own that keeps to the line's rate: it hands characters on when their last
bit would have come (10 bits each for 8N1 and 7E1), in pieces of at most 16, as a UART's FIFO does. Both
sides are processes, too, with the driver of the commands. Measured is from the first block's STX to the
last block's ACK, against what the text alone takes on the line. Each run comes after one of plain blocks
and one-character answers without any protocol, over the same cable: what this computer makes of it at
that moment. At last the same in virtual time: what the protocol takes of itself.

Usage: python bench/dnc.py [--baud N] [--lines N] [--characters N] [--frame F] [--runs N]
"""

import argparse
import multiprocessing
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parent.parent))

from coordinator.dnc.driver import Driver
from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.port import Port
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.engine import Engine
from tests.coordinator.dnc.cable import Cable
from tests.coordinator.dnc.line import Faults, Line, Owner, Wire


def run_cable(pipe: Connection, baud: float, bits: int) -> None:
    with Cable(baud, bits) as cable:
        pipe.send(cable.names)
        pipe.recv()


def run_receiver(pipe: Connection, name: str, options: DncOptions) -> None:
    port = Port(name, options)
    driver = Driver(port, Engine(options, time.monotonic(), peripheral=True))
    pipe.send("ready")
    lines = []
    while True:
        for event in driver.wait():
            match event:
                case events.Asked():
                    driver.engine.accept()
                case events.Line(text=text):
                    lines.append(text)
                    driver.engine.line_taken()
                case events.Ended():
                    driver.engine.file_kept()
                    pipe.send(lines)
                    return
                case _:
                    pipe.send(event)
                    return


def send(name: str, options: DncOptions, lines: list[bytes]) -> float:
    """Send LINES and return the seconds from the first block to the last answer."""
    port = Port(name, options)
    driver = Driver(port, Engine(options, time.monotonic(), peripheral=False))
    driver.engine.send("D", "BENCH")
    began_s, given = 0.0, 0
    while True:
        for event in driver.wait():
            if isinstance(event, events.LineWanted):
                if given == 0:
                    began_s = time.monotonic()
                if given == len(lines):
                    took_s = time.monotonic() - began_s
                    driver.engine.give_end()
                    driver.flush()
                    port.close()
                    return took_s
                driver.engine.give_line(lines[given])
                given += 1
            else:
                raise SystemExit(str(event))


def run_plain(pipe: Connection, name: str, options: DncOptions, size: int) -> None:
    """Answer each SIZE characters by one."""
    port = Port(name, options)
    pipe.send("ready")
    got = 0
    while True:
        got += len(port.read(1.0))
        if got >= size:
            got -= size
            port.write(b"\x06", 1.0)


def send_plain(name: str, options: DncOptions, size: int, blocks: int) -> float:
    """Send BLOCKS of SIZE, each after the answer to the one before; return the seconds."""
    port = Port(name, options)
    began_s = time.monotonic()
    for _ in range(blocks):
        port.write(bytes(size), 1.0)
        while not port.read(1.0):
            pass
    took_s = time.monotonic() - began_s
    port.close()
    return took_s


def virtual_share(given: argparse.Namespace, options: DncOptions) -> float:
    """Return the text's share of a transfer between engines that take no time."""
    lines = [b"X" * (given.characters - 2)] * given.lines
    control = Owner(Engine(options, 0.0, peripheral=False), lines)
    peripheral = Owner(Engine(options, 0.0, peripheral=True), None)
    control.engine.send("D", "BENCH")
    wires = (Wire(Faults(), options, Random(1)), Wire(Faults(), options, Random(2)))
    line = Line((control, peripheral), wires, Random(3))
    line.run()
    return given.lines * given.characters * options.character_time_s / line.now_s


def measure(given: argparse.Namespace, options: DncOptions, names: list[str]) -> None:
    context = multiprocessing.get_context("spawn")
    text = given.characters - 2
    lines = [f"N{i} G1 X{i * 7}.25 Y".ljust(text, "5").encode() for i in range(given.lines)]
    pipe, end = context.Pipe()
    size = given.characters + 4
    plain = context.Process(target=run_plain, args=(end, names[1], options, size))
    plain.start()
    pipe.recv()
    plain_s = send_plain(names[0], options, size, given.lines)
    plain.terminate()
    plain.join()
    receiver = context.Process(target=run_receiver, args=(end, names[1], options))
    receiver.start()
    pipe.recv()
    took_s = send(names[0], options, lines)
    received = pipe.recv()
    receiver.join()
    if received != lines:
        raise SystemExit(f"not what was sent: {received}")
    line_s = given.lines * given.characters * options.character_time_s
    beside_us = (took_s - line_s) / given.lines * 1e6
    print(
        f"{given.lines * given.characters / took_s:.0f} characters/s, {line_s / took_s:.1%} of the rate"
        f" (without a protocol {line_s / plain_s:.1%}); {beside_us:.0f} us a block beside its text"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--baud", type=int, default=115_200)
    parser.add_argument("--lines", type=int, default=300)
    parser.add_argument("--characters", type=int, default=200, help="of a block's text, CR LF included")
    parser.add_argument("--frame", default="8N1")
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    options = DncOptions(frame=read_frame(given.frame), baud=given.baud)
    context = multiprocessing.get_context("spawn")
    cable_pipe, cable_end = context.Pipe()
    cable = context.Process(target=run_cable, args=(cable_end, given.baud, options.frame.bits))
    cable.start()
    names = cable_pipe.recv()
    print(f"{given.lines} blocks of {given.characters} characters at {given.baud} baud {options.frame}")
    for _ in range(given.runs):
        measure(given, options, names)
    cable_pipe.send("stop")
    cable.join()
    print(f"in virtual time {virtual_share(given, options):.1%}")


if __name__ == "__main__":
    main()
