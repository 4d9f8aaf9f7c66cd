"""What the drivers of a machine have in common: their wires, and the commands that name a stepper."""

from typing import TYPE_CHECKING

from coordinator.config.errors import ConfigError
from coordinator.config.pins import PinDescription
from coordinator.drivers.tmc_chips import Field
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import one, value
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module
from coordinator.support.quoting import nearest_or_all
from nodes.devices.tmcuart import TmcUart
from nodes.support.numbers import read_int

if TYPE_CHECKING:
    from coordinator.modules.drivers.tmc_driver import TmcDriver


class TmcCommands(Module):
    """The commands, and the wires."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._drivers: dict[str, TmcDriver] = {}
        self._wires: dict[tuple[str, str, str], TmcUart] = {}
        for name, text, read in (
            ("INIT_TMC", "Write all registers of the driver of STEPPER= again", self._init),
            ("DUMP_TMC", "Show the registers of the driver of STEPPER=, or only REGISTER=", self._dump),
            (
                "SET_TMC_CURRENT",
                "Set the currents of the driver of STEPPER=: CURRENT= and HOLDCURRENT=, A RMS",
                self._set_current,
            ),
            (
                "SET_TMC_FIELD",
                "Set FIELD= of the driver of STEPPER= to VALUE=, or to the value for VELOCITY= (mm/s)",
                self._set_field,
            ),
        ):
            build.add_command(name, text, read)

    def wire(self, build: Build, rx: "PinDescription", tx: "PinDescription | None") -> tuple[TmcUart, str]:
        """Return the wire on these pins and its node, for the section of BUILD; raises ConfigError."""
        tx = tx or rx
        if tx.node != rx.node:
            raise ConfigError(
                tx.place,
                f"{tx.purpose} is on node '{tx.node}', but uart_pin is on '{rx.node}'; both must be on one"
                " node",
            )
        key = (rx.node, rx.name, tx.name)
        if key not in self._wires:
            self._wires[key] = TmcUart(build.name, rx_pin=rx.name, pull=rx.pull, tx_pin=tx.name)
            build.add_device(rx.node, self._wires[key])
        return self._wires[key], rx.node

    def add(self, driver: "TmcDriver", build: Build) -> None:
        """Register DRIVER; raises ConfigError when its stepper or its address has one already."""
        for other in self._drivers.values():
            if other.stepper.name == driver.stepper.name:
                raise ConfigError(
                    build.place, f"[{other.name}] and [{driver.name}] are for the same stepper; remove one"
                )
            if other.wire is driver.wire and other.address == driver.address:
                raise ConfigError(
                    build.place,
                    f"[{other.name}] and [{driver.name}] have the same pins and uart_address"
                    f" {driver.address}; give each driver of a wire its own",
                )
        self._drivers[driver.stepper.name] = driver

    # ------------------------------------------------------------------------------------------ commands

    def _driver(self, call: Call, given: dict[str, str]) -> "TmcDriver":
        return self._drivers[one(call.command, given, "STEPPER", self._drivers)]

    def _init(self, call: Call) -> Reading:
        driver = self._driver(call, call.parameters("STEPPER"))

        async def perform() -> Done:
            await driver.set_up()
            return Done()

        return AtStandstill(perform)

    def _dump(self, call: Call) -> Reading:
        given = call.parameters("STEPPER", "REGISTER")
        driver = self._driver(call, given)
        only = one(call.command, given, "REGISTER", driver.CHIP.registers) if "REGISTER" in given else ""

        async def perform() -> Done:
            return Done(tuple(await driver.dump(only)))

        return AtStandstill(perform)

    def _set_current(self, call: Call) -> Reading:
        given = call.parameters("STEPPER", "CURRENT", "HOLDCURRENT")
        driver = self._driver(call, given)
        most = driver.settings.largest_a
        for name in ("CURRENT", "HOLDCURRENT"):
            if name in given and not 0 < value(call.command, given, name) <= most:
                raise WordError(
                    f"{name} of SET_TMC_CURRENT is {quoted(given[name])}; it must be above 0 and at most"
                    f" {most:.3f} A"
                )

        async def perform() -> Done:
            run_a = value(call.command, given, "CURRENT", driver.run_a)
            await driver.set_current(run_a, value(call.command, given, "HOLDCURRENT", driver.hold_a))
            text = f"{driver.stepper.name}: run current {driver.run_a:g} A, hold current {driver.hold_a:g} A"
            return Done((text,))

        return AtStandstill(perform)

    def _set_field(self, call: Call) -> Reading:
        given = call.parameters("STEPPER", "FIELD", "VALUE", "VELOCITY")
        driver = self._driver(call, given)
        name = given.get("FIELD", "").lower()
        register = driver.CHIP.field_register(name)
        if register is None:
            names = driver.CHIP.writable_fields
            hint = nearest_or_all(name, names)
            raise WordError(f"SET_TMC_FIELD: there is no field {quoted(name)}{hint}")
        field = register.field(name)
        number = self._field_value(call, driver, given, field)
        if number == 0 and name == "toff":
            raise WordError("SET_TMC_FIELD: toff 0 switches the motor off; use SET_STEPPER_ENABLE for that")

        async def perform() -> Done:
            await driver.set_fields({name: number})
            return Done()

        return AtStandstill(perform)

    @staticmethod
    def _field_value(call: Call, driver: "TmcDriver", given: dict[str, str], field: Field) -> int:
        if ("VALUE" in given) == ("VELOCITY" in given):
            raise WordError("SET_TMC_FIELD needs VALUE= or VELOCITY=, one of both")
        if "VELOCITY" in given:
            speed = value(call.command, given, "VELOCITY")
            number: int | None = driver.settings.tstep(speed) if speed > 0 else None
        else:
            number = read_int(given["VALUE"], may_be_hex=True)
        if number is None or not 0 <= number <= field.maximum:
            raise WordError(f"SET_TMC_FIELD: {field.name} takes whole numbers from 0 to {field.maximum}")
        return number
