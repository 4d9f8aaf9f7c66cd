"""From a snapshot of the state tree to what Prometheus reads; sans-IO, in any thread."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
)
from prometheus_client.core import (
    Metric as Family,
)
from prometheus_client.registry import Collector

from coordinator.metrics.catalog import BUSES, GROUPS, MODULES, NODES, PREFIX, Group, Kind, Metric
from coordinator.support.values import Value
from nodes.support.terminal import printable

ENTITIES_MAX: Final = 256
"""Nodes, buses, and sections, that are shown; each node is some eighty series."""
LABEL_MAX: Final = 80
"""Characters of a label's value."""
_NUMBER: Final = re.compile(r"\d[\d.,]*")
_SOMEBODY: Final = re.compile(r"(emergency stop by).*", re.DOTALL)

_SEVERAL: Final = (NODES, BUSES, MODULES)
_OF_MODULES: Final = {metric.field for metric in MODULES.metrics}

Fields = Mapping[str, Value]


class Figures(Collector):
    """The fields of one moment, by their paths, for ``generate_latest``."""

    def __init__(self, fields: Fields) -> None:
        self._trees = _split(fields)
        self._trees[MODULES.prefix] = {
            path: own for path, own in self._trees[MODULES.prefix].items() if own.keys() & _OF_MODULES
        }
        self.left_out = sum(max(0, len(self._trees[group.prefix]) - ENTITIES_MAX) for group in _SEVERAL)

    def collect(self) -> Iterator[Family]:
        """Return all metrics, those without any figure too."""
        self._trees["metrics"][""]["left_out"] = self.left_out
        for group in GROUPS:
            shown = list(self._trees[group.prefix].items())[:ENTITIES_MAX]
            entities = list(zip(_labels(group, shown), (fields for _, fields in shown), strict=True))
            for metric in group.metrics:
                yield _family(group, metric, entities)


def registry_of(fields: Fields) -> CollectorRegistry:
    """Return what the encoders of prometheus-client take."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(Figures(fields))
    return registry


def _split(fields: Fields) -> dict[str, dict[str, dict[str, Value]]]:
    """Return the fields by group and entity: of some groups there are several, of others one, ""."""
    several = {group.prefix for group in _SEVERAL}
    trees: dict[str, dict[str, dict[str, Value]]] = {
        group.prefix: {} if group.prefix in several else {"": {}} for group in GROUPS
    }
    for path, value in fields.items():
        prefix, _, rest = path.partition(".")
        if prefix not in trees:
            continue
        entity, field = "", rest
        if prefix in several:
            entity, _, field = rest.partition(".")
        trees[prefix].setdefault(entity, {})[field] = value
    return trees


def _labels(group: Group, entities: Sequence[tuple[str, Fields]]) -> list[list[str]]:
    """Return the labels that tell the ENTITIES of GROUP apart; no two may be the same."""
    labels: list[list[str]] = []
    names: set[str] = set()
    for path, fields in entities:
        name = _label(fields.get("name"))
        name = path if name in names else name
        names.add(name)
        named = {"node": name, "bus": _label(fields.get("bus")) if group is NODES else name, "section": path}
        labels.append([named[label] for label in group.labels])
    return labels


def _label(value: Value) -> str:
    return "" if value is None else printable(str(value))[:LABEL_MAX]


# --------------------------------------------------------------------------------------------- families

Sample = tuple[list[str], float]
"""The values of all labels, and the figure."""


def _family(group: Group, metric: Metric, entities: Sequence[tuple[list[str], Fields]]) -> Family:
    name, sentence = f"{PREFIX}{metric.name}", f"{group.sentence}: {metric.sentence}"
    labels = [*group.labels, *metric.labels, *(["state"] if metric.kind is Kind.STATE else [])]
    if metric.kind is Kind.HISTOGRAM:
        histogram = HistogramMetricFamily(name, sentence, labels=labels)
        for own, fields in entities:
            if buckets := lead_buckets(fields.get(metric.field)):
                histogram.add_metric(own, buckets, None)
        return histogram
    kind = CounterMetricFamily if metric.kind is Kind.COUNTER else GaugeMetricFamily
    family = kind(name, sentence, labels=labels)
    read = _READERS.get(metric.kind, _number)
    for own, fields in entities:
        for more, figure in read(metric, fields):
            family.add_metric([*own, *more], figure)
    return family


def _number(metric: Metric, fields: Fields) -> Iterator[Sample]:
    value = fields.get(metric.field)
    if metric.field == "waits_for":
        yield [], float(value is not None)
    elif (figure := _figure(value, metric)) is not None:
        yield [], figure


def _figure(value: Value, metric: Metric) -> float | None:
    """Return VALUE in base units; None when it is no figure that Prometheus would take."""
    if not isinstance(value, (bool, int, float)):
        return None
    try:
        figure = float(value) * metric.scale
    except OverflowError:
        return None
    sound = math.isfinite(figure) and (figure >= 0 or metric.kind is not Kind.COUNTER)
    return figure if sound else None


def _state(metric: Metric, fields: Fields) -> Iterator[Sample]:
    value = fields.get(metric.field)
    if not isinstance(value, str):
        return
    for word in metric.words:
        yield [word], float(word == value)
    if value not in metric.words:
        yield ["other"], 1.0


def _by_key(metric: Metric, fields: Fields) -> Iterator[Sample]:
    if metric.field == "load":
        for name, share in fields.items():
            figure = _figure(share, metric)
            if name.startswith("load_") and name != "load_total" and figure is not None:
                yield [name.removeprefix("load_")], figure
        return
    value = fields.get(metric.field)
    if isinstance(value, str):
        value = dict.fromkeys(value.lower(), 1)
    if isinstance(value, Mapping):
        figures = {_label(key): _figure(part, metric) for key, part in list(value.items())[:ENTITIES_MAX]}
        yield from (([key], figure) for key, figure in figures.items() if figure is not None)


def _info(metric: Metric, fields: Fields) -> Iterator[Sample]:
    if metric.field == "cause":
        if cause := fields.get("cause"):
            yield [cause_kind(str(cause))], 1.0
    elif metric.field in fields:
        yield [_label(fields.get(label)) for label in metric.labels], 1.0


_READERS: Final[Mapping[Kind, Callable[[Metric, Fields], Iterator[Sample]]]] = {
    Kind.STATE: _state,
    Kind.BY_KEY: _by_key,
    Kind.INFO: _info,
}


def cause_kind(cause: str) -> str:
    """Return a cause without what makes each one different: every other label value is a series for ever."""
    return _label(_NUMBER.sub("#", _SOMEBODY.sub(r"\1 somebody", cause)))


def lead_buckets(histogram: Value) -> list[tuple[str, float]]:
    """Return cumulative buckets, in s, of counts by lead: late, < 1 ms, < 2 ms, < 4 ms, …, the rest."""
    if not isinstance(histogram, list) or len(histogram) < 2:
        return []
    counts = [count for count in histogram if isinstance(count, int) and 0 <= count < 2**63]
    if len(counts) != len(histogram):
        return []
    edges = ["0.0", *(str(2**k * 1e-3) for k in range(len(counts) - 2)), "+Inf"]
    total = 0
    buckets: list[tuple[str, float]] = []
    for edge, number in zip(edges, counts, strict=True):
        total += number
        buckets.append((edge, float(total)))
    return buckets
