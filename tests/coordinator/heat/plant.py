"""A heater as physics has it, for tests of what controls it. Shares no code with what it tests."""

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

STEP_S = 0.01


@dataclass
class Plant:
    """A block with capacity and loss, heated after a transport delay; a sensor that lags, with noise."""

    power_w: float = 40.0
    capacity: float = 14.0
    loss: float = 0.09
    sensor_tau_s: float = 3.0
    delay_s: float = 0.8
    noise_k: float = 0.05
    ambient_c: float = 22.0
    seed: int = 1
    fan_loss: float = 0.0
    """More loss, W/K, by a fan at full speed."""
    filament_j_per_mm_k: float = 0.0
    """Heat that a mm of filament takes per K."""
    other_w: float = 0.0
    """Heat that comes from elsewhere."""
    block_c: float = field(init=False)
    sensor_c: float = field(init=False)
    now_s: float = field(default=100.0, init=False)
    fan: float = field(default=0.0, init=False)
    filament_mm_per_s: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.block_c = self.sensor_c = self.ambient_c
        self.random = random.Random(self.seed)
        self.pipe: deque[float] = deque([0.0] * max(1, round(self.delay_s / STEP_S)))

    def measure(self) -> float:
        return self.sensor_c + self.random.gauss(0, self.noise_k)

    def run(self, power: float, seconds: float) -> None:
        assert 0 <= power <= 1
        for _ in range(round(seconds / STEP_S)):
            self.pipe.append(power * self.power_w)
            heat = self.pipe.popleft() + self.other_w
            loss = self.loss + self.fan * self.fan_loss + self.filament_mm_per_s * self.filament_j_per_mm_k
            heat -= loss * (self.block_c - self.ambient_c)
            self.block_c += heat / self.capacity * STEP_S
            self.sensor_c += (self.block_c - self.sensor_c) / self.sensor_tau_s * STEP_S
            self.now_s += STEP_S


HOT_END = Plant
INTERVAL_S = 0.3


def bed() -> Plant:
    return Plant(power_w=250, capacity=700, loss=1.2, sensor_tau_s=12, delay_s=2.0, noise_k=0.03)


def drive(
    plant: Plant,
    power: Callable[[float, float], float],
    seconds: float,
    each: Callable[[], None] = lambda: None,
) -> list[tuple[float, float]]:
    """Let POWER(now, measured) heat PLANT for SECONDS; return (time, true sensor temperature)."""
    seen = []
    for _ in range(round(seconds / INTERVAL_S)):
        each()
        plant.run(power(plant.now_s, plant.measure()), INTERVAL_S)
        seen.append((plant.now_s, plant.sensor_c))
    return seen
