"""The UART of stepper drivers on a node: up to four drivers on one wire, distinguished by address.

A write is not answered, but a driver counts the valid writes (IFCNT): after several writes the counter shows
whether all of them arrived.
"""

import asyncio
from collections.abc import Sequence
from typing import Final

from nodes.devices import tmc_datagram
from nodes.devices.device import Device
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

COMMANDS: Final = ("config_tmcuart", "tmcuart_send")
RESPONSES: Final = ("tmcuart_response oid=%c read=%*s",)
BAUD: Final = 40_000
BAUD_SLOW: Final = 9_000
"""On 8-bit micro-controllers."""
SLOW_MCUS: Final = ("at90usb", "atmega")
TRIES: Final = 5
"""Reads or writes of a driver before it counts as failed."""
IFCNT: Final = 0x02
_COUNTS: Final = 1 << 8


class TmcError(CanductorError):
    """A driver does not respond as it should; the text continues "the driver of x "."""


class TmcUart(Device):
    """The wire on RX_PIN, with PULL 1 for a pull-up, and TX_PIN, which may be the same; NAME is for messages.

    Several tasks may use it at a time: their reads and writes do not mix.
    """

    def __init__(self, name: str, *, rx_pin: str, pull: int, tx_pin: str) -> None:
        super().__init__(f"the UART of {name}")
        self._rx_pin, self._tx_pin, self._pull = rx_pin, tx_pin, pull
        self._lock: asyncio.Lock | None = None

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pins do not allow it."""
        config.require(self.description, COMMANDS, RESPONSES)
        mcu = config.dictionary.constants.get("MCU", "")
        slow = isinstance(mcu, str) and mcu.startswith(SLOW_MCUS)
        bit_time = round(config.dictionary.clock_freq_hz / (BAUD_SLOW if slow else BAUD))
        self.oid = config.create_oid()
        config.add_config(
            self.description,
            f"config_tmcuart oid={self.oid} rx_pin={self._rx_pin} pull_up={self._pull}"
            f" tx_pin={self._tx_pin} bit_time={bit_time}",
        )

    async def read(self, node: Node, address: int, register: int) -> int:
        """Return the value of a register of a driver; raises TmcError, or the failure of NODE."""
        async with self._exclusive():
            return await self._read(node, address, register)

    async def write(self, node: Node, address: int, values: Sequence[tuple[int, int]]) -> None:
        """Set registers of a driver, (register, value) each, in order, and check that all writes arrived.

        Raises TmcError, or the failure of NODE.
        """
        async with self._exclusive():
            for _ in range(TRIES):
                before = await self._read(node, address, IFCNT)
                for register, value in values:
                    await self._send(node, tmc_datagram.write(address, register, value), 0)
                after = await self._read(node, address, IFCNT)
                if (after - before) % _COUNTS == len(values):
                    return
        raise TmcError(
            f"did not accept what was written to it, {TRIES} times; check its UART's wiring and for"
            " other drivers of the same uart_address"
        )

    async def _read(self, node: Node, address: int, register: int) -> int:
        damaged = False
        for _ in range(TRIES):
            bits = await self._send(node, tmc_datagram.request(address, register), tmc_datagram.ANSWER_BYTES)
            value = tmc_datagram.parse_answer(bits, register)
            if value is not None:
                return value
            damaged = damaged or bool(bits)
        if damaged:
            raise TmcError(
                "sends damaged answers; check its UART's wiring and for other drivers of the same"
                " uart_address"
            )
        raise TmcError("does not answer; check that its motor supply is on, and uart_pin and uart_address")

    async def _send(self, node: Node, bits: bytes, read: int) -> bytes:
        answer = await node.query("tmcuart_send", "tmcuart_response", oid=self._oid, write=bits, read=read)
        return answer.data("read")

    def _exclusive(self) -> asyncio.Lock:
        if self._lock is None:
            self._lock = asyncio.Lock()
        return self._lock
