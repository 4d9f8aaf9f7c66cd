"""What Prometheus would read from a machine that prints on virtual nodes."""

import asyncio
import signal
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from coordinator.ipc.client import Client
from coordinator.metrics.catalog import GROUPS, NOT_SHOWN, Kind, Metric, full_name
from coordinator.metrics.collect import LABEL_MAX
from coordinator.service.figures import field_name
from tests.stages.processes import SQUARE, Command, Hardware
from tests.system.test_discover import free_port, secrets_of

LIMIT_S = 60.0
Samples = dict[str, dict[frozenset[tuple[str, str]], float]]


def scrape(port: int) -> Samples:
    """Return all samples by name and labels, read by prometheus-client's parser."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=LIMIT_S) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        text = answer.read().decode()
    samples: Samples = {}
    types: dict[str, str] = {}
    for family in text_string_to_metric_families(text):
        types[family.name] = family.type
        for sample in family.samples:
            samples.setdefault(sample.name, {})[frozenset(sample.labels.items())] = sample.value
    for metric in (metric for group in GROUPS for metric in group.metrics):
        assert types[f"canductor_{metric.name}"] == metric.kind.type, metric
    return samples


def test_the_figures_are_those_of_the_state(machine: Hardware, tmp_path: Path) -> None:
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    (jobs / "square.gcode").write_text(SQUARE, encoding="utf-8")
    port, path = free_port(), tmp_path / "sock"

    async def go() -> None:
        async with asyncio.timeout(LIMIT_S), Client.connect(str(path)) as client:
            assert await asyncio.to_thread(state_of, "machine_state") == "ready"
            await client.call("job.start", {"file": "square.gcode"})
            seen: set[str] = set()
            while "done" not in seen:
                seen.add(await asyncio.to_thread(state_of, "job_state"))
                assert not seen & {"failed", "stopped", "other"}
            assert "printing" in seen
            await check(client)
            await client.call("machine.emergency_stop", {"who": "a test"})
            while await asyncio.to_thread(state_of, "machine_state") != "shutdown":
                pass
            causes = (await asyncio.to_thread(scrape, port))["canductor_machine_cause_info"]
            assert causes == {frozenset({("cause", "emergency stop by somebody")}): 1.0}

    def state_of(name: str) -> str:
        (state,) = (dict(s)["state"] for s, is_it in scrape(port)[f"canductor_{name}"].items() if is_it)
        return state

    def fresh() -> Samples:
        """Return an answer that was made after this was called: one is given to all for a second."""
        made = scrape(port)["canductor_metrics_requests_total"]
        while (samples := scrape(port))["canductor_metrics_requests_total"] == made:
            pass
        return samples

    async def check(client: Client) -> None:
        """Compare what stands still with the state, and see that nothing of the state is forgotten."""
        for _ in range(20):  # what changes and changes back in a second may be seen in between
            before = (await client.call("state.get", {"fields": ["*"]}))["values"]
            samples = await asyncio.to_thread(fresh)
            after = (await client.call("state.get", {"fields": ["*"]}))["values"]
            steady = {key: value for key, value in before.items() if after.get(key) == value}
            compared, wrong = compare(steady, samples)
            if not wrong:
                break
        assert not wrong
        assert compared > 50
        assert not forgotten(before), "declare these in coordinator/metrics/catalog.py, or as NOT_SHOWN"
        (leads,) = (
            value
            for labels, value in samples["canductor_node_command_lead_seconds_bucket"].items()
            if {("node", "mcu"), ("le", "+Inf")} <= labels
        )
        assert leads == sum(before["nodes.mcu.lead_histogram"]) > 0
        assert samples["canductor_node_clock_drift_ratio"]
        assert samples["canductor_api_clients"] == {frozenset(): 1.0}
        assert samples["canductor_api_requests_total"][frozenset()] >= 2

    tokens, _ = secrets_of(tmp_path)
    quiet = ("--tcp", f"127.0.0.1:{free_port()}", "--tokens", tokens, "--no-tls-on-loopback")
    words = ("run", machine.config, "--ipc", path, "--jobs", jobs, "--metrics", str(port), *quiet)
    with Command(*words) as command:
        command.stdout.wait_for(f"metrics are at http://127.0.0.1:{port}/metrics")
        command.stdout.wait_for("ready")
        asyncio.run(go())
        command.signal(signal.SIGTERM)
        ended = command.end()
    assert (ended.status, ended.stderr) == (0, "")
    assert "announced as" not in ended.stdout  # nobody else could reach the port


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
