"""DTR and RTS of serial devices, and the switch for the power of USB ports."""

import os
from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.transport import open_uart
from nodes.transport.usb_power import usb_power_switch


def test_a_pseudo_terminal_has_no_lines() -> None:
    master, slave = os.openpty()
    uart = open_uart(os.ttyname(slave))
    try:
        assert not uart.has_lines
        with pytest.raises(CanductorError, match="cannot set DTR and RTS"):
            uart.set_lines(True, True)
    finally:
        uart.close()
        os.close(master)
        os.close(slave)


def test_a_computer_without_switch(tmp_path: Path) -> None:
    assert usb_power_switch(tmp_path) is None


def test_the_switch_of_a_raspberry_pi(tmp_path: Path) -> None:
    file = tmp_path / "soc" / "3f980000.usb" / "buspower"
    file.parent.mkdir(parents=True)
    file.write_text("1")
    switch = usb_power_switch(tmp_path)
    assert switch is not None
    switch(False)
    assert file.read_text() == "0"
    switch(True)
    assert file.read_text() == "1"
    file.unlink()
    file.mkdir()
    with pytest.raises(CanductorError, match=r"cannot switch the power of the USB ports by .*buspower: "):
        switch(False)
