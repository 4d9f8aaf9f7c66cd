"""How much of a serial line's rate BCC uses: a file through two pseudo-terminals with a cable of that rate between.

The cable is a process of its own: it hands characters on when their last bit would have come (10 bits of 1/baud
each for 8N1 and 7E1), in pieces of at most 16, as a UART's FIFO does. Both sides are processes, too, each with the
command's own driver; what is measured is from the first block's STX to the last block's ACK, against the time that
the text alone would take on the line.

Usage: python bench/dnc.py [--baud N] [--lines N] [--characters N] [--frame F]
"""

import argparse
import multiprocessing
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from coordinator.dnc import events
from coordinator.dnc.driver import Driver
from coordinator.dnc.engine import Engine
from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.port import Port
from tests.coordinator.dnc.cable import Cable


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
                    return took_s
                driver.engine.give_line(lines[given])
                given += 1
            else:
                raise SystemExit(str(event))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--baud", type=int, default=115_200)
    parser.add_argument("--lines", type=int, default=500)
    parser.add_argument("--characters", type=int, default=200, help="of a block's text, CR LF included")
    parser.add_argument("--frame", default="8N1")
    given = parser.parse_args()
    options = DncOptions(frame=read_frame(given.frame), baud=given.baud)
    lines = [f"N{i} G1 X{i * 7}.25 Y".ljust(given.characters - 2, "5").encode() for i in range(given.lines)]
    context = multiprocessing.get_context("spawn")
    cable_pipe, cable_end = context.Pipe()
    cable = context.Process(target=run_cable, args=(cable_end, given.baud, options.frame.bits))
    cable.start()
    names = cable_pipe.recv()
    receiver_pipe, receiver_end = context.Pipe()
    receiver = context.Process(target=run_receiver, args=(receiver_end, names[1], options))
    receiver.start()
    receiver_pipe.recv()
    took_s = send(names[0], options, lines)
    received = receiver_pipe.recv()
    cable_pipe.send("stop")
    cable.join()
    receiver.join()
    if received != lines:
        raise SystemExit(f"not what was sent: {received}")
    line_s = given.lines * given.characters * options.character_time_s
    print(
        f"{given.lines} blocks of {given.characters} characters at {given.baud} baud {options.frame}: {took_s:.3f} s"
    )
    print(
        f"text: {given.lines * given.characters / took_s:.0f} characters/s, {line_s / took_s:.1%} of the line's rate"
    )
    print(f"beside its text a block takes {(took_s - line_s) / given.lines * 1e6:.0f} us")


if __name__ == "__main__":
    main()
