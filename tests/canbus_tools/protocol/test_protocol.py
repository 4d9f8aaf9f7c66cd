"""The description of the protocol agrees with those who speak it."""

import pytest

from canbus_tools.protocol.protocol import (
    ADMIN_FRAMES,
    BLOCK,
    SIGNAL_FRAMES,
    Direction,
    FieldKind,
    FrameFormat,
    data_id,
    frame_format,
    owner_of,
)
from tests import wire_twin as twin

ALL = (*ADMIN_FRAMES, *SIGNAL_FRAMES)


def test_data_ids() -> None:
    assert (data_id(4, Direction.TO_NODE), data_id(4, Direction.FROM_NODE)) == (0x108, 0x109)
    for nodeid in range(1, 256):
        for direction in (Direction.TO_NODE, Direction.FROM_NODE):
            assert owner_of(data_id(nodeid, direction)) == (nodeid, direction)
    for can_id in (0, 0x0FF, 0x100, 0x101, 0x300, 0x3F0, 0x3F1, 0x7FF):
        assert owner_of(can_id) is None


@pytest.mark.parametrize("form", ALL, ids=lambda form: form.name)
def test_every_format_is_found_by_its_id_and_first_byte(form: FrameFormat) -> None:
    data = bytes(() if form.command is None else (form.command,)).ljust(form.size, b"\x01")
    assert 0 < form.size <= 8
    for can_id in range(form.can_id, form.can_id + form.ids):
        assert frame_format(can_id, data) is form
        assert frame_format(can_id, data + b"\x00") is form
        assert frame_format(can_id, data[:-1]) is None
    assert form.sentence.endswith((".", "?"))
    assert all(field.sentence for field in form.fields)


def test_names_are_unique_and_uuids_have_their_size() -> None:
    assert len({form.name for form in ALL}) == len(ALL)
    assert {f.size for form in ALL for f in form.fields if f.kind is FieldKind.UUID} == {6}


def test_the_block_format_is_the_codecs() -> None:
    assert list(BLOCK.values()) == [5, 64, 0x10, 2, 0x8408, 0xFFFF, 0x7E]
    crc = BLOCK["crc_start"]
    for byte in b"123456789":
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (BLOCK["crc_polynomial"] if crc & 1 else 0)
    assert crc == 0x6F91 == twin.crc16(b"123456789")
