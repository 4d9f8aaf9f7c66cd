"""The boards of a scenario: simulated nodes by its settings and the seed, and what their pins did."""

import json
import zlib
from functools import lru_cache
from typing import Final

import numpy as np

from coordinator.simulate.scenario import NodeSetting
from coordinator.simulate.script import ScriptedWorld
from coordinator.simulate.truth import BoardTruth
from coordinator.support.toml_values import Dice
from nodes.dictionary.dictionary import Dictionary
from nodes.virtual._sim import ffi, lib
from nodes.virtual.world import CanWire, Latency, NodeSettings, Uart, WorldNode

PS_PER_NS: Final = 1000

EXTENSIONS: Final = frozenset(
    (
        *("CAN_SYNC_PULSE", "CAN_TRIGGER_GROUPS", "CAN_BUS_STOP", "CAN_WHO_IS_HERE"),
        *("get_sync_pulse", "sync_pulse", "trsync_set_group", "set_bus_stop"),
        *(
            "MT_AXLES",
            "config_table",
            "table_bytes",
            "table_query",
            "table_state",
            "table_read",
            "table_pair",
        ),
        *("table_activate", "table_query_active", "table_active", "table_find", "table_found"),
        *("config_table_register", "table_register_poll", "table_register_write"),
    )
)
"""Missing in the dictionary of firmware without this project's extensions."""


class Board:
    """The simulated board NAME at WIRE of WORLD, with the values of SETTING drawn by DICE."""

    def __init__(
        self,
        world: ScriptedWorld,
        wire: CanWire | Uart,
        name: str,
        *,
        uuid: str,
        setting: NodeSetting,
        dice: Dice,
    ) -> None:
        self.name = name
        self.wire = wire
        self._world = world

        def draw(option: str) -> float:
            return dice.draw(getattr(setting, option), f"nodes.{name}.{option}")

        blob = dictionary_blob(setting.clock_hz, setting.legacy, setting.config_reset)
        self.dictionary = _parsed(blob)
        self.clock_hz = round(self.dictionary.clock_freq_hz)
        self._ppm = draw("ppm")
        self._latency_s = draw("latency_us") * 1e-6
        self.node: WorldNode = world.add_node(
            wire,
            uuid,
            settings=NodeSettings(ppm=self._ppm, task=self._task(0.0), boot_s=draw("boot_s")),
            start_clock=2**32 - round(draw("rollover_after_s") * self.clock_hz) % 2**32,
            clock_freq=self.clock_hz if setting.clock_hz else 0,
            move_count=setting.move_slots,
            dictionary=None if blob == dictionary_blob(0) else blob,
            legacy=setting.legacy,
        )
        self._begin(draw("power_on_s"), draw("ramp_ppm_per_s"), draw("ramp_s"))

    def _begin(self, power_on_s: float, ramp_ppm_per_s: float, ramp_s: float) -> None:
        now_ns = self._world.now_ns
        if power_on_s > 0:
            self.node.power_off()
            self._world.at(now_ns + round(power_on_s * 1e9), self.node.power_on)
        if ramp_ppm_per_s:
            self.node.set_rate(self._ppm, ramp_ppm_per_s)
            self._world.at(now_ns + round(ramp_s * 1e9), lambda: self.node.set_rate(self.node.ppm))

    def _task(self, busy_s: float) -> Latency:
        return Latency(busy_s + 5e-6, self._latency_s / 3, busy_s + max(self._latency_s, 5e-6))

    def stall(self, duration_s: float) -> None:
        """Delay its tasks by DURATION_S; its timers and interrupts continue."""
        self.node.set_pace(task=self._task(duration_s))
        end_ns = self._world.now_ns + round(duration_s * 1e9)
        self._world.at(end_ns, lambda: self.node.set_pace(task=self._task(0.0)))

    def truth(self) -> BoardTruth:
        """Return the changes of its pins."""
        edges = self.node.edges()
        return BoardTruth(
            at_ns=edges["true_ps"] // PS_PER_NS,
            pin=np.ascontiguousarray(edges["pin"]),
            level=np.ascontiguousarray(edges["level"]),
            life=np.ascontiguousarray(edges["life"]),
        )

    def overflow(self) -> int:
        """Return how many bytes found its receive buffer full, since its last start."""
        return self.node.counters()["rx_overflow_bytes"]

    @property
    def pins(self) -> dict[str, int]:
        """Numbers of its pins by name."""
        return dict(self.dictionary.enumerations["pin"].values)


@lru_cache
def dictionary_blob(clock_hz: int, legacy: bool = False, config_reset: str = "clears") -> bytes:
    """Return the compressed dictionary of the simulated board, for a clock of CLOCK_HZ (0: as built).

    LEGACY: as of firmware that does not have this project's extensions. CONFIG_RESET: as in NodeSetting.
    """
    if not clock_hz and not legacy and config_reset == "clears":
        size = ffi.new("uint32_t *")
        found = lib.sim_dictionary(size)
        return bytes(ffi.buffer(found, size[0]))
    words = json.loads(zlib.decompress(dictionary_blob(0)))
    if clock_hz:
        words["config"]["CLOCK_FREQ"] = clock_hz
    if config_reset != "clears":
        del words["commands"]["config_reset"]
    if config_reset == "restarts":
        words["commands"]["config_reset"] = words["commands"].pop("reset")
    if legacy:
        for table in ("config", "commands", "responses"):
            words[table] = {k: v for k, v in words[table].items() if k.split()[0] not in EXTENSIONS}
    return zlib.compress(json.dumps(words, separators=(",", ":")).encode(), 9)


@lru_cache
def _parsed(blob: bytes) -> Dictionary:
    return Dictionary.parse(blob)
