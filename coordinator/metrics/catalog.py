"""All metrics: which field of the state tree each one shows, as what, and in which unit.

docs/metrics.md has the same as a table: paste what ``python -m coordinator.metrics.catalog`` prints.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from nodes.support.terminal import show


class Kind(StrEnum):
    """What a figure is to Prometheus."""

    GAUGE = "gauge"
    COUNTER = "counter"
    STATE = "state"
    """A gauge for each word the field may be, 1 for the one it is: label ``state``."""
    BY_KEY = "by key"
    """A gauge for each entry of a map, or each letter of a word."""
    INFO = "info"
    """A gauge that is always 1, with the information in its labels."""
    HISTOGRAM = "histogram"

    @property
    def type(self) -> str:
        """The type for Prometheus."""
        return str(self) if self in (Kind.COUNTER, Kind.HISTOGRAM) else "gauge"


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric, without the prefix ``canductor_`` (and for a counter without ``_total``)."""

    field: str
    """Of the state tree, within its group."""
    name: str
    sentence: str
    kind: Kind = Kind.GAUGE
    scale: float = 1.0
    """Base units in one unit of the field."""
    labels: tuple[str, ...] = ()
    """Beyond those of the group."""
    words: tuple[str, ...] = ()
    """All that a STATE may be; another word is shown as ``other``."""


@dataclass(frozen=True, slots=True)
class Group:
    """Metrics with the same labels; PREFIX is where their fields are in the tree."""

    prefix: str
    sentence: str
    labels: tuple[str, ...]
    metrics: tuple[Metric, ...]


PREFIX: Final = "canductor_"
_MS, _US, _MM = 1e-3, 1e-6, 1e-3

SERVICE_STATES: Final = ("startup", "ready", "printing", "paused", "shutdown", "error")
JOB_STATES: Final = (
    *("none", "printing", "pausing", "paused", "cancelling"),
    *("done", "cancelled", "failed", "stopped"),
)
NODE_STATES: Final = (
    *("connecting", "identifying", "configuring", "ready"),
    *("shutdown", "lost", "sleeping", "closed"),
)

MACHINE: Final = Group(
    "machine",
    "The machine",
    (),
    (
        Metric("state", "machine_state", "what the machine is doing", Kind.STATE, words=SERVICE_STATES),
        Metric(
            "cause",
            "machine_cause_info",
            "why it is stopped or waits; numbers as #, absent without a cause",
            Kind.INFO,
            labels=("cause",),
        ),
        Metric("starts", "machine_starts", "how often it was started", Kind.COUNTER),
        Metric("waits_for", "machine_waiting", "1 while motion waits for a node that is away"),
        Metric(
            "stop_confirmed_ms",
            "machine_stop_confirmed_seconds",
            "how long after the last stop a node confirmed it",
            Kind.BY_KEY,
            _MS,
            labels=("node",),
        ),
        Metric("lead_ms", "machine_lead_seconds", "how far ahead commands are made", scale=_MS),
        Metric("lead_min_ms", "machine_lead_min_seconds", "the least of that", scale=_MS),
    ),
)
JOB: Final = Group(
    "job",
    "The job",
    (),
    (
        Metric("state", "job_state", "the state of the last one", Kind.STATE, words=JOB_STATES),
        Metric("progress", "job_progress_ratio", "share of the file that is done"),
        Metric("size_bytes", "job_size_bytes", "size of the file"),
        Metric("done_bytes", "job_done_bytes", "of the file, done"),
        Metric("read_bytes", "job_read_bytes", "of the file, read"),
        Metric("line", "job_line", "line that is carried out"),
        Metric("lines_read", "job_lines_read", "lines read, some seconds ahead"),
        Metric("lines_fed", "job_lines_fed", "lines that came, of a job without a file"),
        Metric("print_time_s", "job_print_time_seconds", "time printed, without pauses"),
        Metric("elapsed_s", "job_elapsed_seconds", "time since it began, with pauses"),
    ),
)
POSITION: Final = Group(
    "position",
    "Motion",
    (),
    (
        Metric(
            "commanded", "position_meters", "where the machine is now", Kind.BY_KEY, _MM, labels=("axis",)
        ),
        Metric("velocity_mm_s", "velocity_meters_per_second", "along the path, now", scale=_MM),
        Metric("moving", "moving", "1 while it moves"),
        Metric("homed", "axis_homed", "1 for each homed axis", Kind.BY_KEY, labels=("axis",)),
        Metric("speed_factor", "speed_factor_ratio", "M220"),
        Metric("extrude_factor", "extrude_factor_ratio", "M221"),
        Metric("print_time_s", "print_time_seconds", "clock of the primary node"),
    ),
)
NODES: Final = Group(
    "nodes",
    "Each node",
    ("node", "bus"),
    (
        Metric("state", "node_state", "where it is in its life", Kind.STATE, words=NODE_STATES),
        Metric(
            "mcu",
            "node_info",
            "what it is",
            Kind.INFO,
            labels=("mcu", "firmware", "firmware_version", "policy", "clock_source", "uuid"),
        ),
        Metric("clock_freq_hz", "node_clock_frequency_hertz", "nominal frequency of its clock"),
        Metric("clock_offset_s", "node_clock_offset_seconds", "its clock less this computer's"),
        Metric("clock_error_us", "node_clock_error_seconds", "bound of the error of its clock", scale=_US),
        Metric(
            "clock_drift_ppm",
            "node_clock_drift_ratio",
            "how much faster than nominal its clock runs: 1e-6 is 1 ppm",
            scale=1e-6,
        ),
        Metric(
            "lead_ms",
            "node_lead_seconds",
            "link margin: where the lowest lead of the last second lies; absent without motion",
            scale=_MS,
        ),
        Metric("lead_min_ms", "node_lead_min_seconds", "smallest lead since the link was opened", scale=_MS),
        Metric(
            "lead_histogram",
            "node_command_lead_seconds",
            "commands by the time left until due, when acknowledged; le 0: late",
            Kind.HISTOGRAM,
        ),
        Metric("queue_commands", "node_queue_commands", "motion commands that wait in the host"),
        Metric("queue_commands_max", "node_queue_commands_max", "the most of those ever"),
        Metric("control_commands", "node_control_commands", "other commands that wait in the host"),
        Metric("move_count", "node_move_slots", "moves that fit into its own queue"),
        Metric("commands_sent", "node_sent_commands", "commands sent", Kind.COUNTER),
        Metric("bytes_sent", "node_sent_bytes", "bytes sent, repeats included", Kind.COUNTER),
        Metric("retransmitted_blocks", "node_retransmitted_blocks", "blocks sent again", Kind.COUNTER),
        Metric("retransmitted_bytes", "node_retransmitted_bytes", "bytes sent again", Kind.COUNTER),
        Metric("invalid_bytes", "node_invalid_bytes", "received, part of no sound block", Kind.COUNTER),
        Metric("round_trip_ms", "node_round_trip_seconds", "smoothed", scale=_MS),
        Metric("load_awake", "node_load_ratio", "share of its time in tasks"),
        Metric("load_task_us", "node_task_seconds", "mean time of one round of its tasks", scale=_US),
    ),
)
BUSES: Final = Group(
    "buses",
    "Each bus",
    ("bus",),
    (
        Metric("bitrate", "bus_bitrate_bits_per_second", "0: not known, loads are 0 then"),
        Metric(
            "load",
            "bus_load_ratio",
            "share of the bit rate within the last second, by class",
            Kind.BY_KEY,
            labels=("class",),
        ),
        Metric("load_total", "bus_load_all_ratio", "all classes together"),
        Metric("frames_sent", "bus_sent_frames", "frames sent", Kind.COUNTER),
        Metric("frames_received", "bus_received_frames", "frames received", Kind.COUNTER),
        Metric("frames_malformed", "bus_malformed_frames", "received, and no sound frames", Kind.COUNTER),
        Metric("frames_dropped", "bus_dropped_frames", "that gave way: the host was slow", Kind.COUNTER),
        Metric("bytes_sent", "bus_sent_bytes", "bytes sent, of a serial line", Kind.COUNTER),
        Metric("bytes_received", "bus_received_bytes", "likewise received", Kind.COUNTER),
        Metric("send_waits", "bus_send_waits", "times the kernel took no more", Kind.COUNTER),
    ),
)
MODULES: Final = Group(
    "modules",
    "Each heater, sensor and fan",
    ("section",),
    (
        Metric("temperature", "temperature_celsius", "as it was measured last"),
        Metric("target", "temperature_target_celsius", "what it is to be; 0: off"),
        Metric("power", "heater_power_ratio", "what a heater is given now"),
        Metric("held_s", "heater_held_seconds", "how long a target is held, in steady state; absent before"),
        Metric("held_low", "heater_held_low_celsius", "the lowest measured in that time"),
        Metric("held_high", "heater_held_high_celsius", "the highest"),
        Metric("speed", "fan_speed_ratio", "of a fan, as it was set"),
        Metric("rpm", "fan_turns_per_second", "by its tachometer", scale=1 / 60),
    ),
)
API: Final = Group(
    "api",
    "The interface for other programs",
    (),
    (
        Metric("connections", "api_clients", "clients connected"),
        Metric(
            "refused_connections",
            "api_refused_connections",
            "too many, wrong tokens before, or not the owner's",
            Kind.COUNTER,
        ),
        Metric("requests", "api_requests", "requests served", Kind.COUNTER),
        Metric("failed", "api_failed_requests", "of those, answered with an error", Kind.COUNTER),
        Metric("refused_busy", "api_rate_limited_requests", "refused: too many at once", Kind.COUNTER),
        Metric("updates", "api_updates", "updates sent to watchers", Kind.COUNTER),
        Metric("updates_skipped", "api_merged_updates", "merged into later ones", Kind.COUNTER),
        Metric(
            "notifications_dropped", "api_dropped_notifications", "not read by their client", Kind.COUNTER
        ),
        Metric("bytes_out", "api_sent_bytes", "sent to clients", Kind.COUNTER),
        Metric("unsendable", "api_unsendable_values", "left out: no message can carry them", Kind.COUNTER),
    ),
)
SELF: Final = Group(
    "metrics",
    "This endpoint",
    (),
    (
        Metric("version", "build_info", "always 1", Kind.INFO, labels=("name", "version", "api")),
        Metric("scrapes", "metrics_requests", "answers to Prometheus", Kind.COUNTER),
        Metric("refused", "metrics_refused_requests", "other requests, and too many at once", Kind.COUNTER),
        Metric("collect_s", "metrics_collect_seconds", "what it took to make the last answer but this"),
        Metric("left_out", "metrics_left_out", "nodes, buses and sections beyond the most that are shown"),
    ),
)
GROUPS: Final = (MACHINE, JOB, POSITION, NODES, BUSES, MODULES, API, SELF)
NOT_SHOWN: Final = {
    # Words and numbers without end: one more series for each.
    "job": ("file", "message", "interrupted_file", "interrupted_line"),
    "position": ("planned", "gcode", "origin"),  # seconds ahead of where the machine is
    "nodes": ("name", "bus", "nodeid", "state_text", "failure"),
    "buses": ("name",),
    "modules": ("*",),  # but for heat, each kind of module has fields of its own
}
"""Fields of the state tree that are no metrics, * for all; of the nodes' and buses', some are labels."""


def full_name(metric: Metric) -> str:
    """Return the name as Prometheus has it."""
    return f"{PREFIX}{metric.name}{'_total' if metric.kind is Kind.COUNTER else ''}"


def table() -> str:
    """Return all metrics as tables in Markdown."""
    lines: list[str] = []
    for group in GROUPS:
        lines += [f"### {group.sentence}", "", "| metric | type | labels | meaning |", "|---|---|---|---|"]
        for metric in group.metrics:
            state = ("state",) if metric.kind is Kind.STATE else ()
            labels = ", ".join(group.labels + metric.labels + state)
            lines.append(
                f"| `{full_name(metric)}` | {metric.kind.type} | {labels} | {_meaning(group, metric)} |"
            )
        lines.append("")
    return "\n".join(lines)


def _meaning(group: Group, metric: Metric) -> str:
    if metric.kind is Kind.STATE:
        return f"{metric.sentence}: 1 for one of {', '.join(metric.words)}"
    if group is API or group is SELF or metric.field == "load" or metric.kind is Kind.INFO:
        return metric.sentence
    return f"{metric.sentence} (`{metric.field}`)"


if __name__ == "__main__":
    show(table(), end="")
