"""A heater's sensor in a simulated machine: its wire breaks for some measurements, or it falls silent."""

from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.sensors.temperature_input import TemperatureInput
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.stages.heat_machine import HeatMachine


class Sensor:
    """The sensor of heater KEY, on a machine that lives."""

    def __init__(self, stage: HeatMachine, key: str = "extruder") -> None:
        heaters = stage.machine.modules.find("heaters", HeaterRegistry)
        assert heaters is not None
        self.unit = heaters.units[key]
        self._stage = stage

    async def good(self, measurements: int) -> None:
        """Let so many sound measurements come."""
        self._stage.fault(PlantItemKind.SENSOR, PlantFault.SOUND)
        for _ in range(measurements):
            await self.unit.input.next()
        assert self.unit.input.celsius is not None
        assert self.unit.input.min_c <= self.unit.input.celsius <= self.unit.input.max_c

    async def bad(self, measurements: int, fault: PlantFault = PlantFault.OPEN) -> None:
        """Let so many come that cannot be."""
        self._stage.fault(PlantItemKind.SENSOR, fault)
        for _ in range(measurements):
            await self.unit.input.next()
            assert self.unit.input.celsius is not None
            assert not self.unit.input.min_c <= self.unit.input.celsius <= self.unit.input.max_c
            assert self.unit.power == 0

    def silence(self) -> None:
        """Have its node measure no more."""
        source = self.unit.input
        assert isinstance(source, TemperatureInput)
        source._analog.stop(self._stage.machine.nodes[source.node])
