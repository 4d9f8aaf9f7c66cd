"""Runs tshark with the dissector on frames."""

import json
import shutil
import struct
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from canbus_tools.dissector.dissector import dissector
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.dictionary.dictionary import Dictionary

NANOSECOND_PCAP = 0xA1B23C4D
LINKTYPE_CAN_SOCKETCAN = 227
FLAGS = {FrameKind.DATA: 0, FrameKind.EXTENDED: 1 << 31, FrameKind.REMOTE: 1 << 30, FrameKind.ERROR: 1 << 29}
TIMEOUT_S = 100.0


def write_pcap(path: Path, frames: Iterable[Frame]) -> None:
    """Write the frames as Wireshark records SocketCAN."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", NANOSECOND_PCAP, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN))
        for frame in frames:
            packet = struct.pack(">IB3x", frame.can_id | FLAGS[frame.kind], len(frame.data)) + frame.data
            seconds, ns = divmod(round(frame.time_s * 1e9), 10**9)
            file.write(struct.pack("<IIII", seconds, ns, len(packet), len(packet)) + packet)


class Tshark:
    """tshark with a dissector of DICTIONARIES, working in FOLDER."""

    def __init__(self, folder: Path, dictionaries: Mapping[int | str, Dictionary]) -> None:
        if shutil.which("tshark") is None:
            pytest.skip("tshark is not installed (apt-get install tshark)")
        self._script = folder / "canductor.lua"
        self._script.write_text(dissector(dictionaries), encoding="utf-8")
        self._capture = folder / "capture.pcap"

    def use(self, script: Path) -> None:
        """Take another dissector."""
        self._script = script

    def load(self, frames: Iterable[Frame]) -> None:
        """Take these frames."""
        write_pcap(self._capture, frames)

    def load_buses(self, buses: Iterable[Iterable[Frame]]) -> None:
        """Take the frames of several buses, in the order of time."""
        if shutil.which("mergecap") is None:
            pytest.skip("mergecap is not installed (apt-get install wireshark-common)")
        paths = []
        for number, frames in enumerate(buses):
            paths.append(self._capture.with_name(f"bus{number}.pcap"))
            write_pcap(paths[-1], frames)
        command = ["mergecap", "-I", "none", "-w", str(self._capture), *map(str, paths)]
        subprocess.run(command, check=True, timeout=TIMEOUT_S)

    def run(self, *words: str) -> str:
        """Return what tshark prints; fails when the Lua code does."""
        command = ["tshark", "-n", "-X", f"lua_script:{self._script}", "-r", str(self._capture), *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        assert done.returncode == 0, done.stderr
        complaints = [line for line in done.stderr.splitlines() if "as user" not in line]
        assert complaints == []
        return done.stdout

    def layers(self, fields: Sequence[str], *words: str) -> list[dict[str, list[str]]]:
        """Return the values of FIELDS of every frame, by field."""
        options = [word for field in (*fields, "_ws.lua.error") for word in ("-e", field)]
        packets: list[dict[str, Any]] = json.loads(self.run("-T", "json", *options, *words))
        found = [packet["_source"].get("layers", {}) for packet in packets]
        errors = [layers["_ws.lua.error"] for layers in found if "_ws.lua.error" in layers]
        assert errors == []
        return found
