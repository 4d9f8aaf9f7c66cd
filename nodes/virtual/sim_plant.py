"""The plant of a simulated board (firmware/boards/sim)."""

from collections.abc import Callable, Mapping
from typing import Any

from nodes.support.errors import CanductorError
from nodes.virtual._sim import ffi, lib
from nodes.virtual.plant import NodePlant
from nodes.virtual.plant_page import PlantPage


class SimPlant:
    """PLANT of BOARD (``struct sim_board *``, which outlives this), from now on; it survives resets.

    NOW_NS returns true time; by default that of the board's last event.
    """

    def __init__(self, board: Any, plant: NodePlant, now_ns: Callable[[], int] = lambda: 0) -> None:
        self.description = plant
        self.board = board
        self._now_ns = now_ns
        text, error = plant.text().encode(), ffi.new("char[]", lib.SIM_ERROR)
        if lib.sim_plant_start(board, now_ns(), text, len(text), error):
            reason = ffi.string(error)
            assert isinstance(reason, bytes)
            raise CanductorError(f"the plant of node {plant.node}: {reason.decode()}")
        size = ffi.new("size_t *")
        page = lib.sim_plant_page(board, size)
        self._page = PlantPage(f"the plant of node {plant.node}", ffi.buffer(page, size[0]))

    @property
    def page(self) -> PlantPage:
        """Its true state now."""
        lib.sim_plant_update(self.board, self._now_ns())
        return self._page


def connect_plants(plants: Mapping[str, SimPlant]) -> None:
    """Connect the plants of the boards of a machine; CanductorError when one is missing."""
    for plant in plants.values():
        for name in plant.description.peers:
            if name not in plants:
                raise CanductorError(
                    f"the plant of node {plant.description.node} refers to node '{name}', which has no plant"
                )
            lib.sim_plant_peer(plant.board, name.encode(), plants[name].board)
