"""An endstop on a node: an input that is sampled while an axis moves towards it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from nodes.devices.trsync import TriggerReason
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_endstop", "endstop_home", "endstop_query_state")
SAMPLE_S: Final = 15e-6
"""Between two samples of one look."""
SAMPLE_COUNT: Final = 4
"""Samples in a row that have to agree: a spike of the cable is shorter."""


@dataclass(frozen=True, slots=True)
class EndstopState:
    """What an endstop's node says."""

    homing: bool
    """Whether it is being sampled."""
    next_clock32: int
    """When it is looked at next; after a trigger, a rest behind the first sample of the look that did it."""
    pressed: bool


class Endstop:
    """The endstop of NAME (a rail): PIN of its node, PULL 1 for a pull-up; INVERT: pressed is a low level."""

    def __init__(self, name: str, *, pin: str, pull: int, invert: bool) -> None:
        self.name = name
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self._pin = pin
        self._pull = pull
        self._invert = invert

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = f"the endstop of {self.name}"
        config.require(what, COMMANDS)
        self.oid = config.create_oid()
        config.add_config(what, f"config_endstop oid={self.oid} pin={self._pin} pull_up={self._pull}")

    def home(self, node: "Node", *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Look every REST_TICKS from CLOCK on, and trigger the stop group when it is pressed."""
        sample_ticks = max(1, round(SAMPLE_S * node.clock_freq_hz))
        times = {"clock": clock % 2**32, "sample_ticks": sample_ticks, "rest_ticks": rest_ticks}
        self._home(node, times, SAMPLE_COUNT, trsync_oid)

    def end(self, node: "Node") -> None:
        """Look no more."""
        self._home(node, {"clock": 0, "sample_ticks": 0, "rest_ticks": 0}, 0, 0)

    def _home(self, node: "Node", times: Mapping[str, int], sample_count: int, trsync_oid: int) -> None:
        node.send(
            "endstop_home",
            oid=self._oid,
            **times,
            sample_count=sample_count,
            pin_value=int(not self._invert),
            trsync_oid=trsync_oid,
            trigger_reason=int(TriggerReason.ENDSTOP),
        )

    async def state(self, node: "Node") -> EndstopState:
        """Ask its node."""
        answer = await node.query("endstop_query_state", "endstop_state", oid=self._oid)
        pressed = bool(answer.integer("pin_value")) != self._invert
        return EndstopState(bool(answer.integer("homing")), answer.integer("next_clock"), pressed)

    @property
    def _oid(self) -> int:
        if self.oid is None:
            raise NodeError(f"the endstop of {self.name} is not configured on any node")
        return self.oid
