"""What a program asks of one stepper: its motion cut where positions are declared or settings change."""

from collections.abc import Sequence
from dataclasses import replace

from coordinator.motion.specs import StepperSpec
from coordinator.streaming.pipeline import MotionSettings
from coordinator.verification.exact_bed import ExactBed
from coordinator.verification.exact_path import Leg, Setting
from coordinator.verification.exact_shapers import impulses
from coordinator.verification.planned import Segment


def program_legs(spec: StepperSpec, segments: Sequence[Segment]) -> list[Leg]:
    """Return the legs of the stepper SPEC, whose weights hold unless SEGMENTS have others."""
    return [
        Leg(
            replace(spec, weights=segment.settings.weights.get(spec.name, spec.weights)),
            segment.start,
            segment.moves,
            _setting(segment.settings, spec.name),
            declared=segment.declared,
        )
        for segment in segments
    ]


def _setting(settings: MotionSettings, stepper: str) -> Setting:
    shapers = {
        axis: impulses(shaper.kind, shaper.frequency_hz, shaper.damping_ratio)
        for axis, shaper in settings.shapers.items()
    }
    bed = None if settings.surface is None else ExactBed(settings.surface)
    return Setting(shapers, settings.windows_s.get(stepper, 0.0), bed)
