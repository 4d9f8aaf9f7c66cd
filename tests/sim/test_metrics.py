"""What Prometheus would read from a machine that prints, in virtual time: the figures of the state."""

from pathlib import Path
from typing import Any

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from coordinator.ipc.protocol.methods import Scope
from coordinator.metrics.catalog import GROUPS, NOT_SHOWN, Kind, Metric, full_name
from coordinator.metrics.collect import LABEL_MAX, registry_of
from coordinator.service.state.figures import field_name
from tests.stages.demo_machine import SQUARE, DemoMachine
from tests.stages.interface import Interface
from tests.stages.served import Served

Samples = dict[str, dict[frozenset[tuple[str, str]], float]]


def scrape(stage: Served, interface: Interface) -> tuple[dict[str, Any], Samples]:
    """Return the state and, by name and labels, all samples of the same moment, as Prometheus reads them."""
    figures = {f"api.{name}": value for name, value in interface.server.figures().items()}
    state = stage.tree.snapshot().values | figures
    text = generate_latest(registry_of(state)).decode()
    samples: Samples = {}
    types: dict[str, str] = {}
    for family in text_string_to_metric_families(text):
        types[family.name] = family.type
        for sample in family.samples:
            samples.setdefault(sample.name, {})[frozenset(sample.labels.items())] = sample.value
    for metric in (metric for group in GROUPS for metric in group.metrics):
        assert types[f"canductor_{metric.name}"] == metric.kind.type, metric
    return state, samples


def state_of(samples: Samples, name: str) -> str:
    (state,) = (dict(labels)["state"] for labels, holds in samples[f"canductor_{name}"].items() if holds)
    return state


def test_the_figures_are_those_of_the_state(tmp_path: Path) -> None:
    async def go(stage: Served) -> None:
        stage.write_job(SQUARE)
        tokens = tmp_path / "tokens"
        tokens.touch(0o600)
        async with Interface.of(stage, tokens) as interface:
            client = interface.connect(granted=Scope.ADMIN)
            await client.ask("api.hello", version=1)
            assert state_of(scrape(stage, interface)[1], "machine_state") == "ready"
            await client.ask("job.start", file="job.gcode")
            await stage.until(lambda: stage.tree.get("position.moving") is True, "motion")
            for state in ("printing", "done"):
                await stage.until_job(state)
                before, samples = scrape(stage, interface)
                assert state_of(samples, "job_state") == state
                check(before, samples)
            await client.ask("machine.emergency_stop", who="a test")
            samples = scrape(stage, interface)[1]
            assert state_of(samples, "machine_state") == "shutdown"
            causes = samples["canductor_machine_cause_info"]
            assert causes == {frozenset({("cause", "emergency stop by somebody")}): 1.0}

    DemoMachine(tmp_path).serve(go)


def check(state: dict[str, Any], samples: Samples) -> None:
    """Compare the samples with the state, and see that nothing of the state is forgotten."""
    compared, wrong = compare(state, samples)
    assert not wrong
    assert compared > 50
    assert not forgotten(state), "declare these in coordinator/metrics/catalog.py, or as NOT_SHOWN"
    (leads,) = (
        value
        for labels, value in samples["canductor_node_command_lead_seconds_bucket"].items()
        if {("node", "mcu"), ("le", "+Inf")} <= labels
    )
    assert leads == sum(state["nodes.mcu.lead_histogram"]) > 0
    assert samples["canductor_node_clock_drift_ratio"]
    assert samples["canductor_api_clients"] == {frozenset(): 1.0}
    assert samples["canductor_api_requests_total"][frozenset()] >= 1


def compare(state: dict[str, Any], samples: Samples) -> tuple[int, dict[str, Any]]:
    """Look for each plain figure of STATE in SAMPLES; return how many, and those that are others."""
    compared, wrong = 0, {}
    for group in GROUPS:
        for metric in group.metrics:
            for path, value in state.items():
                prefix, _, rest = path.partition(".")
                entity, _, field = rest.rpartition(".")
                if (prefix, field) != (group.prefix, metric.field) or not plain(metric, value):
                    continue
                told = samples[full_name(metric)]
                figures = [v for labels, v in told.items() if is_of(entity, dict(labels), group.labels)]
                if figures != pytest.approx([value * metric.scale]):
                    wrong[path] = (value, figures)
                compared += 1
    return compared, wrong


def plain(metric: Metric, value: object) -> bool:
    return metric.kind in (Kind.GAUGE, Kind.COUNTER) and isinstance(value, (bool, int, float))


def is_of(entity: str, labels: dict[str, str], keys: tuple[str, ...]) -> bool:
    return not entity or field_name(labels[keys[0]]) == entity[:LABEL_MAX]


def forgotten(state: dict[str, Any]) -> set[str]:
    """Return fields of STATE that are neither a metric nor said to be none."""
    known = {(group.prefix, metric.field) for group in GROUPS for metric in group.metrics}
    known |= {(prefix, field) for prefix, fields in NOT_SHOWN.items() for field in fields}
    labels = {label for group in GROUPS for metric in group.metrics for label in metric.labels}
    left = {(path.split(".")[0], path.rpartition(".")[2]) for path in state} - known
    return {
        f"{prefix}.{field}"
        for prefix, field in left
        if field not in labels
        and not (prefix == "buses" and field.startswith("load_"))
        and (prefix, "*") not in known
    }
