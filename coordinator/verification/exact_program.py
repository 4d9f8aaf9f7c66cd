"""What a program asks of one stepper: its motion cut where positions are declared or settings change."""

from collections.abc import Sequence
from dataclasses import replace

from coordinator.motion.specs import StepperSpec
from coordinator.streaming.pipeline import MotionSettings, Segment
from coordinator.verification.exact_path import Leg, Setting
from coordinator.verification.exact_shapers import impulses


def program_legs(spec: StepperSpec, segments: Sequence[Segment]) -> list[Leg]:
    """Return the legs of the stepper SPEC, whose weights hold as long as STRETCHES tell no others."""
    return [
        Leg(
            replace(spec, weights=stretch.acting.weights.get(spec.name, spec.weights)),
            stretch.start,
            stretch.moves,
            _setting(stretch.acting, spec.name),
            declared=stretch.declared,
        )
        for stretch in segments
    ]


def _setting(acting: MotionSettings, stepper: str) -> Setting:
    shapers = {
        axis: impulses(shaper.kind, shaper.frequency_hz, shaper.damping_ratio)
        for axis, shaper in acting.shapers.items()
    }
    return Setting(shapers, acting.windows_s.get(stepper, 0.0))
