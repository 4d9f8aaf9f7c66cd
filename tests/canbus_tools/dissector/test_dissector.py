"""The Wireshark dissector: in tshark it says of every frame what the project's own decoder says."""

import heapq
import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from canbus_tools.dissector.dissector import ANY, lua
from canbus_tools.protocol.decoded import Kind
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, read_dictionary
from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.protocol.protocol import ADMIN_FRAMES, BLOCK, SIGNAL_FRAMES, Direction, data_id
from coordinator.cli import main as cli
from nodes.dictionary.dictionary import Dictionary
from nodes.support._wire import lib
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.transport import CanFrame
from nodes.virtual.firmware import TOOLHEAD, firmware_dictionary, firmware_path
from tests.canbus_tools import recorded
from tests.canbus_tools.tshark import Tshark
from tests.stages.can_stage import MAIN, CanStage
from tests.stages.simulated_computer import WireUser

NODEID = recorded.NODEID
WAIT_S = 1.0
TOOLHEAD_JSON = firmware_path(TOOLHEAD).with_suffix(".json")


def linux_dictionary() -> Dictionary:
    """Of the node in the recorded session."""
    paths = sorted((recorded.SHARED / "dictionaries").glob("linuxprocess*"))
    if not paths:
        pytest.skip("no dictionary of the recorded session in ../shared")
    return read_dictionary(paths[0])


Said = tuple[list[str], list[str]]
"""Of one frame: the kinds of what it completes, and the texts in order."""


def said_by_decoder(frames: Sequence[Frame], dictionaries: dict[int, Dictionary]) -> list[Said]:
    """What every frame completes; frames of other protocols complete nothing."""
    source = DictionarySource(dictionaries)
    source.hear = lambda *_: None  # type: ignore[method-assign]  # the dissector knows only what it was given
    decoder = BusDecoder(source)
    said = []
    for frame in frames:
        found = [d for d in decoder.feed(frame) if d.kind not in (Kind.OTHER, Kind.ERROR)]
        said.append((sorted({d.kind.value for d in found}), [d.text for d in found]))
    return said


def said_by_tshark(tshark: Tshark, *words: str) -> list[Said]:
    """The same from Wireshark."""
    return [
        (sorted(set(layers.get("canductor.kind", []))), layers.get("canductor.text", []))
        for layers in tshark.layers(["canductor.kind", "canductor.text"], *words)
    ]


def count(said: Sequence[Said]) -> int:
    return sum(len(texts) for _, texts in said)


def test_a_real_session_reads_as_our_decoder_reads_it(tmp_path: Path) -> None:
    frames = recorded.frames()
    dictionary = linux_dictionary()
    tshark = Tshark(tmp_path, {ANY: dictionary})
    tshark.load(frames)
    expected = said_by_decoder(frames, {NODEID: dictionary})
    assert count(expected) > 800
    assert said_by_tshark(tshark) == expected
    assert said_by_tshark(tshark, "-2") == expected


def test_damaged_traffic_reads_as_our_decoder_reads_it(tmp_path: Path) -> None:
    """Frames lost, doubled, changed, late: noise, repeats, naks and what can still be read are the same."""
    chance = random.Random(5)
    frames = []
    late_s = 0.0
    for sent in recorded.frames():
        late_s += 0.3 if chance.random() < 0.02 else 0.0
        frame = sent._replace(time_s=sent.time_s + late_s)
        fate = chance.random()
        if fate < 0.03:
            continue
        if fate < 0.06 and frame.data:
            changed = bytearray(frame.data)
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
            frames.append(frame._replace(data=bytes(changed)))
        else:
            frames += [frame, frame] if fate < 0.09 else [frame]
    dictionary = linux_dictionary()
    tshark = Tshark(tmp_path, {NODEID: dictionary})
    tshark.load(frames)
    expected = said_by_decoder(frames, {NODEID: dictionary})
    assert {kind for kinds, _ in expected for kind in kinds} == {"message", "ack", "nak", "noise"}
    assert said_by_tshark(tshark) == expected


def every_frame() -> list[Frame]:
    """One of each admin and signal frame, some with more bytes than they need, and frames that are none."""
    frames = []
    for at, known in enumerate((*ADMIN_FRAMES, *SIGNAL_FRAMES)):
        command = b"" if known.command is None else bytes([known.command])
        fields = bytes(0x11 * (i + 1) % 256 for i in range(known.size - len(command)))
        data = command + fields + (b"\xee" if at % 2 and known.size < 8 else b"")
        frames.append(Frame(float(at), known.can_id + known.ids - 1, data))
    frames += [
        Frame(50.0, 0x3F1, bytes.fromhex("2090a4ae022dfc01")),
        Frame(51.0, 0x3F1, bytes.fromhex("2090a4ae022dfc11")),
        Frame(52.0, 0x3F1, bytes.fromhex("2190a4ae022dfc2a")),
        Frame(53.0, 0x010, bytes(6)),
        Frame(54.0, 0x3F0, b"\x01\x02"),  # too short
        Frame(55.0, 0x3F0, b"\x99"),
        Frame(56.0, 0x3F0, b""),
        Frame(57.0, 0x100, b"\x05"),  # of node 0, which is none
        Frame(58.0, 0x300, b"\x05"),
        Frame(59.0, 0x102, b"", FrameKind.REMOTE),
        Frame(60.0, 0x102, b"\x00", FrameKind.EXTENDED),
        Frame(61.0, 0x2FF, bytes.fromhex("05109e817e")),
        Frame(62.0, 0x2FE, bytes.fromhex("05109e817e7e7e")),
    ]
    return frames


def test_admin_and_signal_frames_read_as_our_decoder_reads_them(tmp_path: Path) -> None:
    frames = every_frame()
    tshark = Tshark(tmp_path, {})
    tshark.load(frames)
    expected = said_by_decoder(frames, {})
    assert count(expected) == len(ADMIN_FRAMES) + len(SIGNAL_FRAMES) + 4 + 2
    assert said_by_tshark(tshark) == expected


@pytest.mark.parametrize(
    ("wanted", "numbers"),
    [
        ('canductor.uuid == "90a4ae022dfc"', [11, 12, 13]),
        ('canductor.uuid == "90a4ae022dfc" && canductor.nodeid == 42', [13]),
        ("canductor.set_command == 0x11", [12]),
        ('canductor.message == "who_is_here"', [6]),
        ("canductor.extension == 1", [5, 6, 8, 9, 10, 13, 14]),
        ("canductor.clock == 0x66554433", [9, 10]),
        ("canductor.seq == 0x11", [5]),
        ('canductor.kind == "ack"', [22]),
        ('canductor.direction == "to" && canductor.nodeid == 255', [23]),
    ],
)
def test_fields_can_be_filtered(tmp_path: Path, wanted: str, numbers: list[int]) -> None:
    tshark = Tshark(tmp_path, {})
    tshark.load(every_frame())
    found = tshark.layers(["frame.number"], "-Y", wanted)
    assert [int(layers["frame.number"][0]) for layers in found] == numbers


def test_parameters_and_frames_of_a_block_can_be_filtered(tmp_path: Path) -> None:
    tshark = Tshark(tmp_path, {NODEID: linux_dictionary()})
    frames = recorded.frames()
    tshark.load(frames)
    wanted = 'canductor.message == "identify_response" && canductor.param.offset == 80'
    (found,) = tshark.layers(
        ["canductor.block.begins_in", "canductor.param.data", "frame.number"], "-Y", wanted
    )
    first, last = int(found["canductor.block.begins_in"][0]), int(found["frame.number"][0])
    payload = b"".join(
        f.data for f in frames[first - 1 : last] if f.can_id == data_id(NODEID, Direction.FROM_NODE)
    )
    assert bytes.fromhex(found["canductor.param.data"][0].replace(":", "")) in payload
    ends = tshark.layers(["frame.number"], "-2", "-Y", f"canductor.block.ends_in == {last}")
    between = [n for n in range(first, last) if frames[n - 1].can_id % 2]
    assert [int(layers["frame.number"][0]) for layers in ends] == between


def test_two_buses_in_one_capture_are_kept_apart(tmp_path: Path) -> None:
    """Both have a node with this id, and their frames alternate."""
    buses = [
        [frame._replace(time_s=start_s + i * 0.001) for i, frame in enumerate(recorded.frames()[:400])]
        for start_s in (1000.0, 1000.0005)
    ]
    dictionary = linux_dictionary()
    tshark = Tshark(tmp_path, {ANY: dictionary})
    tshark.load_buses(buses)
    timed = [
        [
            (frame.time_s, said)
            for frame, said in zip(bus, said_by_decoder(bus, {NODEID: dictionary}), strict=True)
        ]
        for bus in buses
    ]
    expected = [said for _, said in heapq.merge(*timed, key=lambda pair: pair[0])]
    assert said_by_tshark(tshark) == expected
    assert said_by_tshark(tshark, "-2") == expected


# ------------------------------------------------------------------------------------------------ the tool


def test_the_command_writes_a_file_that_wireshark_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out.lua"
    dictionary = str(TOOLHEAD_JSON)
    words = ["can", "dissector", "-o", str(output), "--dictionary", f"7={dictionary}"]
    assert cli.main([*words, "--dictionary", dictionary]) == 0
    said = capsys.readouterr().out
    count = 2 * messages_of(firmware_dictionary(TOOLHEAD))
    assert said.startswith(f"{output} decodes {count} messages; put it into Wireshark's folder")
    assert cli.main(["can", "dissector", "--dictionary", f"7={dictionary}", "--dictionary", dictionary]) == 0
    assert capsys.readouterr().out == output.read_text()
    assert cli.main([*words, "--json"]) == 0
    assert capsys.readouterr().out.startswith('{"ok": true')
    tshark = Tshark(tmp_path, {})
    tshark.use(output)
    tshark.load([Frame(1.0, 0x102, bytes.fromhex("08110100")), Frame(1.1, 0x102, bytes.fromhex("2842247e"))])
    assert said_by_tshark(tshark) == [([], []), (["message"], ["identify offset=0 count=40"])]


def messages_of(dictionary: Dictionary) -> int:
    return len(dictionary.commands) + len(dictionary.responses) + len(dictionary.outputs)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--dictionary", "/no/such.json"], 1, "there is no file '/no/such.json'"),
        (["--dictionary", "256=x"], 2, "--dictionary NODE is '256', must be a whole number from 1 to 255"),
        (["--dictionary", "a", "--dictionary", "b"], 2, "--dictionary is given twice for all nodes"),
        (["--dictionary", "4=a", "--dictionary", "4=b"], 2, "--dictionary is given twice for '4'"),
        (
            ["-o", "/no/such/folder/x.lua"],
            1,
            "dissector '/no/such/folder/x.lua' cannot be written: No such file",
        ),
        (["--json"], 2, "--json needs --output"),
    ],
)
def test_bad_options_are_refused(
    words: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["can", "dissector", *words]) == status
    assert capsys.readouterr().err.startswith(f"canductor: {said}")


def test_any_text_is_a_lua_string() -> None:
    assert lua('a"\\\n\u00e9]]7') == '"a\\034\\092\\010\\195\\169]]7"'
    assert lua({"a": [1, True, 0.5], 3: None}) == '{["a"]={1,true,0.5}}'
    with pytest.raises(TypeError, match="has no form in Lua"):
        lua(object())


# -------------------------------------------------------------------------- real firmware on a simulated bus


class SmallHost:
    """Says things to node 4 and waits until the bus has been quiet for its answers."""

    def __init__(self, bus: WireUser, dictionary: Dictionary) -> None:
        self._bus = bus
        self._dictionary = dictionary
        self._seq = 0

    def send(self, can_id: int, data: bytes) -> None:
        self._bus.send(CanFrame(can_id, data))

    def wait_for(self, can_id: int, end: bytes) -> None:
        """Until a frame with CAN_ID ends with END."""
        while (frame := self._bus.receive(WAIT_S)) is not None:
            if frame.id == can_id and frame.data.endswith(end):
                return
        raise AssertionError(f"no frame {can_id:03x} came that ends with {end.hex()}")

    def block(self, *commands: str) -> bytes:
        content = b"".join(self._dictionary.encode_text(command) for command in commands)
        head = bytes([len(content) + 5, BLOCK["sequence_mark"] | self._seq]) + content
        crc: int = lib.wire_crc16(head, len(head))
        return head + crc.to_bytes(2) + bytes([BLOCK["sync"]])

    def say(self, block: bytes) -> None:
        for at in range(0, len(block), 8):
            self.send(data_id(NODEID, Direction.TO_NODE), block[at : at + 8])

    def ask(self, *commands: str) -> None:
        """Send one block and wait for the empty block that acknowledges it."""
        self.say(self.block(*commands))
        self._seq = (self._seq + 1) % 16
        ack = bytes([5, BLOCK["sequence_mark"] | self._seq])
        crc: int = lib.wire_crc16(ack, len(ack))
        self.wait_for_bytes(ack + crc.to_bytes(2) + bytes([BLOCK["sync"]]))

    def wait_for_bytes(self, wanted: bytes) -> None:
        """Until the node's stream has WANTED, wherever its frames cut it."""
        stream = b""
        while wanted not in stream:
            frame = self._bus.receive(WAIT_S)
            assert frame is not None, f"the node never said {wanted.hex()}"
            if frame.id == data_id(NODEID, Direction.FROM_NODE):
                stream += frame.data


def talk(stage: CanStage, dictionary: Dictionary) -> list[Frame]:
    """All frames of a host's talk with a node of our firmware."""
    uuid = str(MAIN)
    stage.add_node(MAIN, build=TOOLHEAD)
    with stage.computer.listen(stage.options) as recorder, stage.user() as own:
        host = SmallHost(own, dictionary)
        host.send(ADMIN_ID, b"\x00")
        host.wait_for(ADMIN_RESPONSE_ID, bytes.fromhex(uuid) + b"\x01")
        host.send(ADMIN_ID, b"\x01" + bytes.fromhex(uuid) + bytes([NODEID]))
        host.send(ADMIN_ID, b"\x41")
        host.wait_for(ADMIN_RESPONSE_ID, bytes.fromhex(uuid) + bytes([NODEID]))
        host.send(ADMIN_ID, b"\x40\x07")
        for offset in range(0, 400, 40):
            host.ask(f"identify offset={offset} count=40")
        repeated = host.block("get_config")
        host.ask("get_config")
        host.say(repeated)
        host.wait_for_bytes(b"\x7e")
        for _ in range(10):
            host.ask("get_clock", "get_uptime", "get_canbus_id")
            host.ask("get_sync_pulse")
        return recorder.take()


def test_the_traffic_of_our_firmware_reads_as_our_decoder_reads_it(stage: CanStage, tmp_path: Path) -> None:
    dictionary = firmware_dictionary(TOOLHEAD)
    tshark = Tshark(tmp_path, {NODEID: dictionary})
    frames = talk(stage, dictionary)
    tshark.load(frames)
    expected = said_by_decoder(frames, {NODEID: dictionary})
    names = {text.split()[0] for _, texts in expected for text in texts}
    assert {"need_nodeid", "node_is_here", "sync_pulse", "identify_response", "config", "clock"} <= names
    assert "unknown" not in names
    assert said_by_tshark(tshark) == expected
    (found,) = tshark.layers(
        ["canductor.text"], "-Y", 'canductor.repeated == 1 && canductor.direction == "to"'
    )
    assert found["canductor.text"] == ["get_config"]
    read = tshark.run("-T", "fields", "-e", "_ws.col.Protocol", "-e", "_ws.col.Info", "-Y", "canductor.uuid")
    assert read.splitlines()[0] == "CANDUCTOR\tneed_nodeid uuid=90a4ae022dfc set_command=application"
