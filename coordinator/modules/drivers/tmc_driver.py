"""[tmc2209 STEPPER], [tmc2208 STEPPER]: stepper drivers that are set, read and watched over a UART.

`values` has what the registers have to be: they are written when the driver's node is ready, and again when
the node comes back. Every WATCH_S the driver's status is read; on a fault with which a motor must not move
the machine stops, with the cause.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Mapping
from typing import ClassVar, Final

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.model import StepperDescription
from coordinator.drivers.tmc_chips import FAULTS, FORGOTTEN, TMC2208, TMC2209, UNDERVOLTAGE, Chip
from coordinator.drivers.tmc_chips import shown as register_shown
from coordinator.modules.base import Build
from coordinator.modules.drivers.tmc_commands import TmcCommands
from coordinator.modules.drivers.tmc_options import (
    DIAG_PIN,
    ONLY_UART_ADDRESS,
    TX_PIN,
    UART_ADDRESS,
    UART_PIN,
    DriverSettings,
    current_fields,
    driver_spec,
)
from coordinator.modules.homing.virtual_endstop import StallEndstop
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.quoting import nearest_or_all, shown
from coordinator.support.values import Value
from nodes.devices.tmcuart import TmcError
from nodes.node.node import Node
from nodes.support.errors import CanductorError

WATCH_S: Final = 1.0
"""How often a driver's status is read."""
SILENT_MAX: Final = 3
"""How often in a row it may fail to answer."""
GSTAT_ALL: Final = 0b111
"""Written, it clears the flags of a reset and of faults."""
FEELING_SHARE: Final = 0.5
"""StallGuard acts from this share of the homing speed on: below, and at rest, its figures mean nothing."""


class TmcDriver(StallEndstop):
    """One driver."""

    NAMED: ClassVar = True
    CHIP: ClassVar[Chip]

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.stepper = _stepper(build)
        select = build.reader.section.options.get("select_pins")
        if select is not None:
            raise NotSupported(select.place, "drivers that are chosen by select_pins are not supported yet")
        self.settings = DriverSettings(build, self.CHIP, self.stepper)
        self.address = build.get(UART_ADDRESS if self.CHIP.addresses > 1 else ONLY_UART_ADDRESS)
        if self.CHIP.has_stallguard:
            build.find(DIAG_PIN)  # taken by the endstop_pin that names its virtual endstop, if one does
        commands = build.shared(TmcCommands)
        self.wire, self.node_name = commands.wire(build, build.pin(UART_PIN), build.find_pin(TX_PIN))
        commands.add(self, build)
        build.add_device(self.node_name, self)
        self.values: dict[str, int] = self.settings.registers(both_edges=False)
        """What has to be in its registers."""
        self.run_a, self.hold_a = self.settings.run_a, self.settings.hold_a
        self._drv_status: Mapping[str, int] = {}
        self._watch: asyncio.Task[None] | None = None
        self._is_new: asyncio.Event | None = None
        self._warned = False

    # ------------------------------------------------------------------------------------------ device

    def configure(self, config: object) -> None:
        """Do nothing: only the wire is on the node, and the commands have it."""
        del config

    def started(self, node: "Node") -> None:
        """Set the driver again, which may have lost its registers, as its NODE is ready."""
        del node
        if self._is_new is not None:
            self._is_new.set()

    # -------------------------------------------------------------------------------------------- life

    async def connect(self, live: "ModuleContext") -> None:
        """Set the driver; raises CanductorError when it cannot be."""
        await super().connect(live)
        self._is_new = asyncio.Event()
        both_edges = live.machine.devices.steppers[self.stepper.name].steps_on_both_edges
        self.values = self.settings.registers(both_edges=both_edges)
        if self._node.talks:
            await self.set_up()
        else:
            self._is_new.set()
        self._watch = asyncio.get_running_loop().create_task(self._keep_watch())

    def end(self, cause: str) -> None:
        """Stop watching."""
        del cause
        if self._watch is not None:
            self._watch.cancel()

    def status(self) -> Mapping[str, Value]:
        """Report its currents, A, and the last status of the driver."""
        return {
            "run_current": self.run_a,
            "hold_current": self.hold_a,
            "drv_status": dict(self._drv_status) or None,
            "temperature": None,
            "mcu_phase_offset": None,
            "phase_offset_position": None,
        }

    @property
    def _node(self) -> "Node":
        return self.live.node(self.node_name)

    # --------------------------------------------------------------------------------------- registers

    async def read(self, register: str) -> int:
        """Return what is in a register; raises CanductorError."""
        with self._named():
            return await self.wire.read(self._node, self.address, self.CHIP.registers[register].address)

    async def write(self, values: Mapping[str, int]) -> None:
        """Set registers, in order, and see that all arrived; raises CanductorError."""
        pairs = [(self.CHIP.registers[name].address, value) for name, value in values.items()]
        with self._named():
            await self.wire.write(self._node, self.address, pairs)

    async def set_fields(self, fields: Mapping[str, int]) -> None:
        """Set fields from now on; raises CanductorError."""
        await self.write(self._with(fields))
        self.values |= self._with(fields)

    async def set_up(self) -> None:
        """Write everything and see that it is there; raises CanductorError."""
        version = await self.read("IOIN") >> 24
        if version != self.CHIP.version and self._live is not None:
            self._live.say(
                f"[{self.name}]: the driver reports version {version:#x}, but a {self.CHIP.name.upper()} has"
                f" {self.CHIP.version:#x}; check the section's name"
            )
        await self.write(self.values)
        for name, value in self.values.items():
            if self.CHIP.registers[name].readable and await self.read(name) != value:
                raise CanductorError(
                    f"{self._who} does not keep what is written into {name}; check its supply and wiring"
                )
        await self.write({"GSTAT": GSTAT_ALL})
        self._check(0, await self.read("DRV_STATUS"))

    async def set_current(self, run_a: float, hold_a: float) -> None:
        """Set the currents, A RMS; raises CanductorError."""
        await self.set_fields(current_fields(self.settings.currents(run_a, hold_a)))
        self.run_a, self.hold_a = run_a, hold_a

    async def dump(self, only: str = "") -> list[str]:
        """Return all registers for people, or one; those that cannot be read as they were written."""
        lines = []
        for name, register in self.CHIP.registers.items():
            if only and name != only:
                continue
            if register.readable:
                lines.append(register_shown(register, await self.read(name)))
            elif name in self.values:
                lines.append(register_shown(register, self.values[name]) + " (as written)")
        return lines

    def _with(self, fields: Mapping[str, int]) -> dict[str, int]:
        """Return the registers with FIELDS in them."""
        values: dict[str, int] = {}
        for name, value in fields.items():
            register = self.CHIP.field_register(name)
            assert register is not None, name
            before = values.get(register.name, self.values.get(register.name, 0))
            values[register.name] = register.field(name).put(before, value)
        return values

    @contextlib.asynccontextmanager
    async def feeling(self, speed: float) -> AsyncIterator[None]:
        """Enable StallGuard while the axis moves at SPEED (mm/s), in StealthChop as the chip requires."""
        threshold = self.settings.coolstep or speed * FEELING_SHARE
        if threshold >= speed:
            raise CanductorError(
                f"{self._who} cannot detect the end of the axis at {speed:g} mm/s: its coolstep_threshold is"
                f" {threshold:g} mm/s; home faster, or lower it"
            )
        fields = {"en_spreadcycle": 0, "tpwmthrs": 0, "tcoolthrs": self.settings.tstep(threshold)}
        if self.settings.home_a is not None:
            fields |= current_fields(self.settings.currents(self.settings.home_a, self.hold_a))
        feeling = self._with(fields)
        before = {name: self.values.get(name, 0) for name in feeling}
        await self.write(feeling)
        try:
            yield
        except BaseException:
            with contextlib.suppress(CanductorError):  # the error that ended it is reported
                await self.write(before)
            raise
        await self.write(before)

    # ------------------------------------------------------------------------------------------- watch

    async def _keep_watch(self) -> None:
        assert self._is_new is not None
        silent = 0
        while True:
            if not self._node.talks:
                await asyncio.sleep(WATCH_S)
                continue
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WATCH_S):
                    await self._is_new.wait()
            try:
                if self._is_new.is_set():
                    await self.set_up()
                    self._is_new.clear()
                else:
                    self._check(await self.read("GSTAT"), await self.read("DRV_STATUS"))
                silent = 0
            except DriverFaultError as error:
                self.live.stop(str(error))
            except CanductorError as error:
                silent += 1
                if (
                    silent >= SILENT_MAX and self._node.talks
                ):  # else its node's own trouble is reported elsewhere
                    self.live.stop(str(error))
                if self._is_new.is_set():
                    await asyncio.sleep(WATCH_S)

    def _check(self, gstat: int, drv_status: int) -> None:
        """Evaluate the driver's status registers; raises DriverFaultError."""
        register = self.CHIP.registers["DRV_STATUS"]
        said = {field.name: value for field in register.fields if (value := field.of(drv_status))}
        self._drv_status = said
        for fault, sentence in FAULTS.items():
            if fault in said:
                raise DriverFaultError(f"{self._who} {sentence}")
        flags = self.CHIP.registers["GSTAT"]
        if flags.field("reset").of(gstat):
            raise DriverFaultError(f"{self._who} {FORGOTTEN}, then RESTART")
        if flags.field("uv_cp").of(gstat):
            raise DriverFaultError(f"{self._who} {UNDERVOLTAGE}")
        warm = "otpw" in said
        if warm and not self._warned and self._live is not None:
            self._live.say(f"{self._who} is getting too hot; lower run_current or cool it")
        self._warned = warm

    @property
    def _who(self) -> str:
        return f"the driver of {self.stepper.name} ([{self.name}])"

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except TmcError as error:
            raise CanductorError(f"{self._who} {error}") from None


class DriverFaultError(CanductorError):
    """A driver reports a fault with which its motor must not move."""


class Tmc2209(TmcDriver):
    """A TMC2209."""

    CHIP = TMC2209
    SPEC = driver_spec(TMC2209)


class Tmc2208(TmcDriver):
    """A TMC2208, and its like of the same registers: TMC2225."""

    CHIP = TMC2208
    SPEC = driver_spec(TMC2208)


def _stepper(build: Build) -> "StepperDescription":
    """Return the stepper that the section's name names; raises ConfigError."""
    steppers = {stepper.name: stepper for stepper in build.machine.steppers}
    found = steppers.get(build.instance)
    if found is None:
        build.needs_acting(build.instance)
        hint = nearest_or_all(build.instance, steppers)
        raise ConfigError(
            build.place,
            f"[{build.name}] refers to unknown stepper {shown(build.instance)}{hint}",
        )
    return found
