"""The values that pass between a link and its users: defaults, bounds, sums."""

from dataclasses import astuple, fields, replace

import pytest

from nodes.link import BusSettings, Flow, LinkError, LinkSettings, LinkStats, TransportKind
from nodes.link._link import lib
from nodes.link.types import BusLoad, Forecast


def test_kinds_are_those_of_the_c_core() -> None:
    assert TransportKind.CAN_STREAM == lib.IO_CAN_STREAM == 0
    assert TransportKind.CAN_PACKET == lib.IO_CAN_PACKET == 1
    assert TransportKind.BYTES == lib.IO_BYTES == 2


def test_a_link_that_did_nothing_has_counted_nothing() -> None:
    odd = {"min_lead_s": None, "lead_histogram": ()}
    flows = {name: Flow(0, 0, 0) for name in ("motion", "control", "bulk", "received")}
    expected = {field.name: 0 for field in fields(LinkStats)} | odd | flows
    assert {field.name: getattr(LinkStats(), field.name) for field in fields(LinkStats)} == expected


def test_defaults_are_those_of_the_documentation() -> None:
    assert LinkSettings(4) == LinkSettings(4, receive_window=192, lost_after_s=1.0, ahead_s=1.2)
    assert BusSettings().as_dict() == {"bitrate": 0, "ceiling": 0.9, "queue_frames": 0}


@pytest.mark.parametrize(
    ("name", "least", "most", "below", "above"),
    [
        ("bitrate", 0, 100_000_000, -1, 100_000_001),
        ("ceiling", 0.1, 1.0, 0.0999, 1.0001),
        ("queue_frames", 0, 1000, -1, 1001),
    ],
)
def test_settings_of_a_bus_have_bounds(
    name: str, least: float, most: float, below: float, above: float
) -> None:
    for good in (least, most):
        assert BusSettings(**{name: good}).as_dict()[name] == good  # type: ignore[arg-type]
    for bad in (below, above):
        with pytest.raises(LinkError, match=str(bad)):
            BusSettings(**{name: bad})  # type: ignore[arg-type]


def test_a_link_that_did_nothing_counts_nothing() -> None:
    assert not any(astuple(replace(LinkStats(), motion=0, control=0, bulk=0, received=0)))  # type: ignore[arg-type]
    assert not any(astuple(Flow()))


def test_a_load_is_the_sum_of_its_shares() -> None:
    assert BusLoad().total == 0.0
    shares = {field.name: 2.0**-i for i, field in enumerate(fields(BusLoad))}
    assert BusLoad(**shares).total == sum(shares.values())
    for name, share in shares.items():
        assert BusLoad(**{name: share}).total == share


@pytest.mark.parametrize(
    ("late_ns", "warning_s"), [(None, None), (5_250_000_000, 4.0), (1_000_000_000, -0.25)]
)
def test_a_forecast_says_how_early_it_knows(late_ns: int | None, warning_s: float | None) -> None:
    forecast = Forecast(1_250_000_000, 1.5, 9, late_ns, 0.0, 0)
    assert forecast.warning_s == (None if warning_s is None else pytest.approx(warning_s))
