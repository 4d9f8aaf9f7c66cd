"""``mcu`` and ``mcu NAME``: firmware, load and traffic of each node, with the peer's names and units."""

from collections.abc import Mapping
from typing import Any

from coordinator.runtime.machine import Machine, link_of
from nodes.node.load import STATS_INTERVAL_S
from nodes.node.node import Node
from nodes.support.errors import CanductorError


def object_name(node: str) -> str:
    """Return what clients call NODE."""
    return node if node == "mcu" else f"mcu {node}"


def firmware_of(node: "Node") -> Mapping[str, Any]:
    """Return what stays the same for as long as NODE is connected; empty texts before it is known."""
    try:
        dictionary = node.dictionary
    except CanductorError:
        return {"mcu_version": "", "mcu_build_versions": "", "app": "", "mcu_constants": {}}
    return {
        "mcu_version": dictionary.version,
        "mcu_build_versions": dictionary.build_versions,
        "app": dictionary.app,
        "mcu_constants": dictionary.constants,
    }


def stats_of(node: "Node") -> Mapping[str, Any]:
    """Return load and traffic: times in s, ``mcu_awake`` in seconds of five, ``freq`` in Hz as measured."""
    stats: dict[str, Any] = {"mcu_awake": 0.0, "mcu_task_avg": 0.0, "mcu_task_stddev": 0.0}
    load = node.load
    if load is not None:
        stats["mcu_awake"] = round(load.awake * STATS_INTERVAL_S, 4)
        stats["mcu_task_avg"] = round(load.task_s, 6)
        stats["mcu_task_stddev"] = round(load.task_spread_s, 6)
    try:
        stats["freq"] = round(node.clock.estimate().freq_hz) if node.clock_error_s is not None else 0
        link = link_of(node).stats()
    except CanductorError:  # it is lost
        return stats
    return stats | {
        "bytes_write": link.bytes_sent,
        "bytes_read": link.bytes_received,
        "bytes_retransmit": link.bytes_repeated,
        "bytes_invalid": link.bytes_invalid,
        "srtt": round(link.srtt_s, 4),
        "rto": round(link.rto_s, 4),
        "ready_bytes": 0,
        "send_seq": link.blocks_sent,
    }


def node_objects(
    machine: "Machine", firmware: Mapping[str, Mapping[str, Any]]
) -> Mapping[str, Mapping[str, Any]]:
    """Return all nodes of MACHINE by object name; FIRMWARE has what stays the same."""
    return {
        object_name(name): {**firmware.get(name, {}), "last_stats": stats_of(node)}
        for name, node in list(machine.nodes.items())
    }
