"""The wire to stepper drivers: on the real firmware with drivers in its plant, and as real boards know it."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from nodes.devices.tmcuart import BAUD, BAUD_SLOW, IFCNT, TmcError, TmcUart
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfig
from nodes.virtual.plant import NodePlant, Stepper, Tmc
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests import real_dictionaries
from tests.nodes.devices.machine import DeviceMachine

if TYPE_CHECKING:
    from nodes.virtual.sim_plant import SimPlant

GCONF, CHOPCONF, SLAVECONF, IOIN = 0x00, 0x6C, 0x03, 0x06


def driver(name: str, address: int) -> Tmc:
    return Tmc(
        name=name,
        chip="tmc2209",
        stepper=name,
        tx_pin="PC3",
        rx_pin="PC2",
        microsteps=16,
        address=address,
    )


PLANT = NodePlant(
    node="n1",
    steppers=(
        Stepper(name="a", step_pin="PA0", dir_pin="PA1"),
        Stepper(name="b", step_pin="PA2", dir_pin="PA3"),
    ),
    tmcs=(driver("a", 0), driver("b", 3)),
)


class Rig:
    """One node with two drivers on a wire, from shortly before its clock rolls over."""

    def __init__(self) -> None:
        self.uart = TmcUart("a", rx_pin="PC2", pull=1, tx_pin="PC3")
        self.machine = DeviceMachine(self.uart, rolls_over_s=2.52)
        self.plant: SimPlant = self.machine.board.start_plant(PLANT)

    def fail(self, fault: PlantFault) -> None:
        self.plant.page.set_fault(PlantItemKind.TMC, "a", fault)


def test_two_drivers_on_a_wire_are_talked_to_at_once() -> None:
    rig = Rig()
    answers: list[int] = []

    async def main() -> None:
        node = rig.machine.node
        await asyncio.gather(
            rig.uart.write(node, 0, [(SLAVECONF, 0x200), (CHOPCONF, 0x11)]),
            rig.uart.write(node, 3, [(SLAVECONF, 0x200), (CHOPCONF, 0x33)]),
        )
        for address, register in ((0, CHOPCONF), (3, CHOPCONF), (0, IFCNT), (3, IOIN)):
            answers.append(await rig.uart.read(node, address, register))

    rig.machine.run(main)
    assert answers == [0x11, 0x33, 2, 0x21000040]


def test_what_was_not_understood_is_written_again() -> None:
    rig = Rig()
    written: list[int] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(0.020, rig.fail, PlantFault.OPEN)
        loop.call_later(0.024, rig.fail, PlantFault.SOUND)
        await rig.uart.write(rig.machine.node, 0, [(CHOPCONF, number) for number in range(20)])
        written.append(await rig.uart.read(rig.machine.node, 0, CHOPCONF))
        written.append(await rig.uart.read(rig.machine.node, 0, IFCNT))

    rig.machine.run(main)
    value, count = written
    assert value == 19
    assert 20 + 15 < count < 20 + 20, "once with losses, once without"


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [(PlantFault.OPEN, "does not answer"), (PlantFault.GARBLED, "sends damaged answers")],
)
def test_one_that_does_not_answer_is_told_of(fault: PlantFault, sentence: str) -> None:
    rig = Rig()

    async def main() -> None:
        rig.fail(fault)
        with pytest.raises(TmcError, match=sentence):
            await rig.uart.read(rig.machine.node, 0, GCONF)
        assert await rig.uart.read(rig.machine.node, 3, GCONF) == 0x101

    rig.machine.run(main)


@pytest.mark.skipif(not real_dictionaries.PATHS, reason=real_dictionaries.MISSING)
@pytest.mark.parametrize("path", real_dictionaries.PATHS, ids=lambda path: path.stem)
def test_real_boards_know_its_commands(path: Path) -> None:
    dictionary = Dictionary.from_json(path.read_bytes())
    rx_pin, tx_pin, *_ = dictionary.enumerations["pin"].values
    uart = TmcUart("x", rx_pin=rx_pin, pull=0, tx_pin=tx_pin)
    config = NodeConfig("board", dictionary)
    uart.configure(config)
    baud = BAUD_SLOW if path.stem == "atmega2560" else BAUD
    bit_time = round(dictionary.clock_freq_hz / baud)
    assert config.config_commands[-1].endswith(f"tx_pin={tx_pin} bit_time={bit_time}")
    assert dictionary.encode("tmcuart_send", oid=0, write=b"\x05", read=10)
    assert dictionary.responses["tmcuart_response"].names == ("oid", "read")
