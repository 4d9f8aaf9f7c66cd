"""An endstop on a node: an input that is sampled while an axis moves towards it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from nodes.devices.device import Device
from nodes.devices.trsync import TriggerReason
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

COMMANDS: Final = ("config_endstop", "endstop_home", "endstop_query_state")
RESPONSES: Final = ("endstop_state oid=%c homing=%c next_clock=%u pin_value=%c",)
SAMPLE_S: Final = 15e-6
"""Time between two samples of one check."""
SAMPLE_COUNT: Final = 4
"""Consecutive samples that have to agree: a spike on the cable is shorter."""


@dataclass(frozen=True, slots=True)
class EndstopState:
    """State of an endstop, as its node reports it."""

    homing: bool
    """Whether it is being sampled."""
    next_clock32: int
    """When it is checked next; after a trigger, one interval after the first sample of that check."""
    pressed: bool


class Endstop(Device):
    """The endstop of NAME (a rail): PIN of its node, PULL 1 for a pull-up; INVERT: pressed is a low level."""

    def __init__(self, name: str, *, pin: str, pull: int, invert: bool) -> None:
        super().__init__(f"the endstop of {name}")
        self._pin = pin
        self._pull = pull
        self._invert = invert

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = self.description
        config.require(what, COMMANDS, RESPONSES)
        self.oid = config.create_oid()
        config.add_config(what, f"config_endstop oid={self.oid} pin={self._pin} pull_up={self._pull}")

    def home(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Check it every REST_TICKS from CLOCK on, and trigger the stop group when it is pressed."""
        sample_ticks = max(1, round(SAMPLE_S * node.clock_freq_hz))
        times = {"clock": clock % 2**32, "sample_ticks": sample_ticks, "rest_ticks": rest_ticks}
        self._home(node, times, SAMPLE_COUNT, trsync_oid)

    def end(self, node: Node) -> None:
        """Stop checking it."""
        self._home(node, {"clock": 0, "sample_ticks": 0, "rest_ticks": 0}, 0, 0)

    def _home(self, node: Node, times: Mapping[str, int], sample_count: int, trsync_oid: int) -> None:
        node.send(
            "endstop_home",
            oid=self._oid,
            **times,
            sample_count=sample_count,
            pin_value=int(not self._invert),
            trsync_oid=trsync_oid,
            trigger_reason=int(TriggerReason.ENDSTOP),
        )

    async def state(self, node: Node) -> EndstopState:
        """Query its state from its node."""
        answer = await node.query("endstop_query_state", "endstop_state", oid=self._oid)
        pressed = bool(answer.integer("pin_value")) != self._invert
        return EndstopState(bool(answer.integer("homing")), answer.integer("next_clock"), pressed)


class HomingSensor(Protocol):
    """A sensor that may stand in for an endstop."""

    @property
    def errors(self) -> Sequence[str]:
        """Why it ends a homing move, by the number that its node tells; sentences without a full stop."""
        ...

    def begin_homing(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Trigger the stop group when it sees its threshold, from CLOCK on."""

    def end_homing(self, node: Node) -> None:
        """Stop looking."""

    async def state(self, node: Node) -> EndstopState:
        """Return its state; raises CanductorError."""
        ...


class SensorEndstop(Device):
    """An endstop of NAME that is a sensor, which its module configures and sets as ``sensor``."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the sensor of {name}")
        self.sensor: HomingSensor | None = None

    def configure(self, config: NodeConfig) -> None:
        """Add nothing: the sensor is a device of its module."""

    def error(self, number: int) -> str:
        """Return why it ended a homing move, by the NUMBER that its node told."""
        return self._sensor.errors[number]

    @property
    def _sensor(self) -> HomingSensor:
        if self.sensor is None:
            raise CanductorError(f"{self.description} is not connected")
        return self.sensor

    def home(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Trigger the stop group when it sees its threshold, from CLOCK on."""
        self._sensor.begin_homing(node, clock=clock, rest_ticks=rest_ticks, trsync_oid=trsync_oid)

    def end(self, node: Node) -> None:
        """Stop looking."""
        self._sensor.end_homing(node)

    async def state(self, node: Node) -> EndstopState:
        """Return its state; raises CanductorError."""
        return await self._sensor.state(node)
