"""What is made of the fields, read back with prometheus-client's own parsers."""

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client import Metric as Family
from prometheus_client import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from coordinator.metrics import catalog
from coordinator.metrics.catalog import GROUPS, JOB_STATES, NODE_STATES, SERVICE_STATES, Kind
from coordinator.metrics.collect import (
    ENTITIES_MAX,
    LABEL_MAX,
    Figures,
    cause_kind,
    lead_buckets,
    registry_of,
)
from coordinator.service.core.machine_service import ServiceState
from coordinator.service.jobs.jobs import JobPhase
from coordinator.support.values import Value
from nodes.node.states import NodeState
from tests.profiles import examples

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]
FIELDS: dict[str, Value] = {
    "machine.state": "shutdown",
    "machine.cause": "node toolhead did not answer for 0.75 s",
    "machine.starts": 3,
    "machine.waits_for": "toolhead",
    "machine.stop_confirmed_ms": {"mcu": 12.5},
    "job.state": "stopped",
    "job.progress": 0.25,
    "job.file": "secret.gcode",
    "position.commanded": {"x": 10.0, "y": -2.5},
    "position.homed": "XY",
    "position.moving": False,
    "nodes.mcu.name": "mcu",
    "nodes.mcu.bus": "can0",
    "nodes.mcu.state": "lost",
    "nodes.mcu.mcu": 'stm32 "x"\n\\',
    "nodes.mcu.clock_error_us": 21.5,
    "nodes.mcu.clock_drift_ppm": -80.0,
    "nodes.mcu.lead_ms": None,
    "nodes.mcu.lead_histogram": [1, 0, 2, 4],
    "nodes.mcu.retransmitted_blocks": 7,
    "buses.can0.name": "can0",
    "buses.can0.load_motion": 0.5,
    "buses.can0.load_acks": 0.125,
    "buses.can0.load_total": 0.625,
    "buses.can0.frames_sent": 2**40,
    "modules.extruder.temperature": 219.5,
    "modules.extruder.target": 220.0,
    "modules.extruder.power": 0.4,
    "modules.extruder.held_low": None,
    "modules.extruder.control_stats": {"temp_block": 220.25},
    "modules.fan.speed": 0.5,
    "modules.fan.rpm": 3000.0,
    "modules.gcode_macro START.variables": {"x": 1},
    "api.connections": 4,
    "api.requests": 99,
    "metrics.version": "0.1.0",
}


def read(fields: dict[str, Value]) -> Samples:
    """Write FIELDS and read them back; both forms must say the same."""
    text = generate_latest(registry_of(fields)).decode()
    other = generate_openmetrics(registry_of(fields), version="1.0.0").decode()  # type: ignore[no-untyped-call]
    samples = _samples(list(text_string_to_metric_families(text)))
    assert samples == _samples(list(parse_openmetrics(other)))  # type: ignore[no-untyped-call]
    return samples


def _samples(families: list[Family]) -> Samples:
    samples: Samples = {}
    for family in families:
        for sample in family.samples:
            key = (sample.name, tuple(sorted(sample.labels.items())))
            assert key not in samples, f"{key} is there twice: Prometheus would refuse all of it"
            samples[key] = sample.value
    return samples


def test_what_the_fields_become() -> None:
    samples = read(FIELDS)

    def value(name: str, **labels: str) -> float | None:
        return samples.get((f"canductor_{name}", tuple(sorted(labels.items()))))

    assert value("machine_state", state="shutdown") == 1
    assert value("machine_state", state="ready") == 0
    assert value("machine_cause_info", cause="node toolhead did not answer for # s") == 1
    assert value("machine_starts_total") == 3
    assert value("machine_waiting") == 1
    assert value("machine_stop_confirmed_seconds", node="mcu") == 0.0125
    assert value("job_progress_ratio") == 0.25
    assert value("position_meters", axis="y") == -0.0025
    assert value("axis_homed", axis="x") == 1
    assert value("axis_homed", axis="z") is None
    assert value("moving") == 0
    mcu = {"node": "mcu", "bus": "can0"}
    assert value("node_state", state="lost", **mcu) == 1
    assert value("node_clock_error_seconds", **mcu) == pytest.approx(21.5e-6)
    assert value("node_clock_drift_ratio", **mcu) == pytest.approx(-80e-6)
    assert value("node_lead_seconds", **mcu) is None
    assert value("node_command_lead_seconds_bucket", le="0.0", **mcu) == 1
    assert value("node_command_lead_seconds_bucket", le="0.002", **mcu) == 3
    assert value("node_command_lead_seconds_bucket", le="+Inf", **mcu) == 7
    assert value("node_retransmitted_blocks_total", **mcu) == 7
    assert [dict(key[1])["mcu"] for key in samples if key[0] == "canductor_node_info"] == ['stm32 "x"?\\']
    assert value("bus_load_ratio", bus="can0", **{"class": "acks"}) == 0.125
    assert value("bus_load_ratio", bus="can0", **{"class": "total"}) is None
    assert value("bus_load_all_ratio", bus="can0") == 0.625
    assert value("bus_sent_frames_total", bus="can0") == 2**40
    assert value("temperature_celsius", section="extruder") == 219.5
    assert value("temperature_target_celsius", section="extruder") == 220
    assert value("heater_power_ratio", section="extruder") == 0.4
    assert value("heater_held_low_celsius", section="extruder") is None
    assert value("fan_speed_ratio", section="fan") == 0.5
    assert value("fan_turns_per_second", section="fan") == pytest.approx(50)
    assert not any("START" in str(key) for key in samples)
    assert value("api_clients") == 4
    assert value("api_requests_total") == 99
    assert not any("secret" in str(key) for key in samples)


def test_of_a_machine_that_has_not_started_there_is_little() -> None:
    assert {name for name, _ in read({})} == {"canductor_machine_waiting", "canductor_metrics_left_out"}


@settings(max_examples=examples(20))
@given(
    st.dictionaries(
        st.sampled_from(
            [
                f"{g.prefix}.{e}{m.field}"
                for g in GROUPS
                for m in g.metrics
                for e in ("", "a.", "b.", "a.name.")
            ]
            + ["nodes.a.name", "nodes.b.name", "nodes.a", "nodes", "buses.x.load_", "machine.", "job.state.x"]
        ),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=200),
            lambda inner: (
                st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4)
            ),
            max_leaves=6,
        ),
        max_size=30,
    )
)
def test_no_field_whatever_it_is_spoils_the_others(fields: dict[str, Value]) -> None:
    samples = read({**fields, "api.requests": 1})
    assert samples["canductor_api_requests_total", ()] == 1


def test_series_are_bounded() -> None:
    fields: dict[str, Value] = {}
    for number in range(ENTITIES_MAX + 10):
        fields[f"nodes.n{number}.name"] = f"n{number}"
        fields[f"nodes.n{number}.state"] = "word " * 100
        fields[f"nodes.n{number}.bytes_sent"] = 1
    figures = Figures(fields)
    assert figures.left_out == 10
    samples = read(fields)
    assert sum(name == "canductor_node_sent_bytes_total" for name, _ in samples) == ENTITIES_MAX
    assert all(len(value) <= LABEL_MAX for _, labels in samples for _, value in labels)
    assert samples["canductor_metrics_left_out", ()] == 10


def test_sections_without_figures_do_not_push_out_those_with() -> None:
    fields: dict[str, Value] = {f"modules.macro{n}.variables": 1 for n in range(ENTITIES_MAX + 10)}
    fields["modules.extruder.temperature"] = 20.5
    assert Figures(fields).left_out == 0
    assert read(fields)["canductor_temperature_celsius", (("section", "extruder"),)] == 20.5


def test_names_that_are_shortened_to_the_same_stay_apart() -> None:
    long = "n" * LABEL_MAX
    fields: dict[str, Value] = {"nodes.a.name": f"{long}1", "nodes.b.name": f"{long}2"}
    fields |= {"nodes.a.bytes_sent": 1, "nodes.b.bytes_sent": 2}
    assert sorted(v for (name, _), v in read(fields).items() if "sent_bytes" in name) == [1, 2]


def test_causes_that_only_differ_in_figures_are_one_series() -> None:
    assert cause_kind("late by 0.3 s at line 12") == cause_kind("late by 1,250.75 s at line 7")
    assert cause_kind("emergency stop by 'a\nb'") == cause_kind("emergency stop by x") != cause_kind("no")
    assert len(cause_kind("x" * 1000)) == LABEL_MAX


def test_buckets_end_where_the_links_bins_do() -> None:
    edges = [edge for edge, _ in lead_buckets([1] * 16)]
    assert edges[:4] == ["0.0", "0.001", "0.002", "0.004"]
    assert edges[-2:] == ["8.192", "+Inf"]  # 2^13 ms, and the rest
    nonsense: list[Value] = [None, [], [1], "1234", [1, "2"], {}]
    assert not any(map(lead_buckets, nonsense))


# ------------------------------------------------------------------------------------------- the catalog


def test_states_are_those_there_are() -> None:
    assert tuple(ServiceState) == SERVICE_STATES
    assert {"none", *JobPhase} == set(JOB_STATES)
    assert tuple(state.name.lower() for state in NodeState) == NODE_STATES


def test_names_follow_the_conventions_of_prometheus() -> None:
    metrics = [metric for group in GROUPS for metric in group.metrics]
    assert len({metric.name for metric in metrics}) == len(metrics)
    for metric in metrics:
        assert re.fullmatch(r"[a-z][a-z_]*[a-z]", metric.name)
        assert not re.search(r"_(total|ms|us|mm|ppm|percent|count|sum|bucket)$", metric.name)
        if metric.field.endswith(("_ms", "_us", "_s")) and metric.field != "velocity_mm_s":
            assert re.search(r"_seconds(_per_second)?$", metric.name), metric
        if metric.field.endswith("_bytes") or metric.field.startswith("bytes_"):
            assert metric.name.endswith("_bytes"), metric
        assert (metric.kind is Kind.INFO) == metric.name.endswith("_info"), metric


PAGE = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text(encoding="utf-8")


def test_the_page_has_all_metrics(capsys: pytest.CaptureFixture[str]) -> None:
    assert catalog.table() in PAGE, "stale: paste what `python -m coordinator.metrics.catalog` prints"
    assert capsys.readouterr().out == ""


def test_the_pages_queries_ask_for_metrics_that_exist() -> None:
    known = {catalog.full_name(metric) for group in GROUPS for metric in group.metrics}
    asked = set(re.findall(r"canductor_[a-z_]+", PAGE.replace(catalog.table(), "")))
    assert asked
    assert {re.sub(r"_bucket$", "", name) for name in asked} <= known
