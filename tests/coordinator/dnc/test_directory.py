"""A list of files, asked for and told: what the protocol leaves open, byte by byte."""

from typing import Any

import pytest

from coordinator.dnc.files import Entry
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import ACK, DIRECTORY_REQUEST, EOT, NAK, SOH, write_block
from coordinator.dnc.protocol.listing import read_listing, write_listing
from nodes.support.errors import CanductorError
from tests.coordinator.dnc.bench import Bench


def test_directory() -> None:
    control, peripheral = Bench(peripheral=False), Bench(peripheral=True)
    control.engine.ask_directory()
    request = control.said()
    assert request == DIRECTORY_REQUEST == bytes.fromhex("131b113020440d0a")
    peripheral.come(request)
    assert peripheral.happened() == [events.DirectoryAsked()]
    peripheral.engine.give_directory(write_listing([Entry("15.H", 513), Entry("A B.NC", 1)], 10_000))
    control.come(peripheral.said(), 0.1)
    assert control.wait(0.3) == bytes([EOT])
    (event,) = control.happened()
    assert isinstance(event, events.Directory)
    listing = read_listing(event.text)
    assert (listing.sectors, listing.free_sectors) == ({"15.H": 2}, 19)
    peripheral.come(bytes([EOT]))
    assert peripheral.happened() == [events.Sent(confirmed=True)]


def asked_for_directory(idle_s: float, **options: Any) -> Bench:
    """A peripheral that was idle for IDLE_S and has said its directory of 960 characters, which take 1 s."""
    peripheral = Bench(peripheral=True, **options)
    peripheral.wait(idle_s)
    peripheral.come(DIRECTORY_REQUEST)
    assert peripheral.happened() == [events.DirectoryAsked()]
    peripheral.engine.give_directory(bytes(959))
    assert len(peripheral.said()) == 960
    return peripheral


@pytest.mark.parametrize("paced", [False, True])
@pytest.mark.parametrize("idle_s", [0.0, 10.0, 100_000.0])
def test_a_directory_after_silence(idle_s: float, paced: bool) -> None:
    """Whether its end comes late counts from when the directory was sent, however long nothing was asked."""
    peripheral = asked_for_directory(idle_s, paced=paced, answer_s=2.0)
    peripheral.wait(1.3)
    peripheral.come(bytes([EOT]))
    assert peripheral.happened() == [events.Sent(confirmed=True)]
    peripheral = asked_for_directory(idle_s, paced=paced, answer_s=2.0)
    peripheral.wait(2.2)
    peripheral.come(bytes([EOT]))
    assert peripheral.failure().endswith("late; it is unknown whether it has the directory")


def test_a_directory_that_is_ended_or_not() -> None:
    peripheral = asked_for_directory(10.0, paced=True)
    peripheral.wait(0.5)
    peripheral.come(bytes([EOT]))
    assert peripheral.failure() == "the control ended the directory before all of it was sent"
    peripheral = asked_for_directory(10.0)
    peripheral.wait(20.0)
    assert peripheral.failure().startswith("nothing was received after the end of the directory in time")
    peripheral = asked_for_directory(10.0)
    peripheral.wait(1.1)
    peripheral.come(bytes([NAK]), 0.5)
    assert peripheral.failure().startswith("the end of the directory was refused")


def test_a_damaged_directory_is_told() -> None:
    with pytest.raises(CanductorError, match="damaged"):
        read_listing(b"\r\n\r\n\r\n\r\n      15\x00H 2\r\n")


def test_a_peripheral_without_directory() -> None:
    control = Bench(peripheral=False)
    control.engine.ask_directory()
    control.said()
    assert control.come(write_block(SOH, b"NO DIRECTORY", dc1=True)) == bytes([ACK, EOT])
    assert control.failure() == "the peripheral reports: NO DIRECTORY"
