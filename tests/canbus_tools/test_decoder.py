"""The decoder of a bus: the recorded session, then all that can go wrong with one."""

from canbus_tools.decoded import Kind
from canbus_tools.decoder import BusDecoder
from tests.canbus_tools import recorded


def test_the_recorded_session_is_read_completely() -> None:
    decoder = BusDecoder()
    said = [item for frame in recorded.frames() for item in decoder.feed(frame)]
    assert decoder.flush() == []
    expected = recorded.messages()
    assert len(said) == len(expected)
    for item, (direction, seq, name, params) in zip(said, expected, strict=True):
        assert (item.direction, item.seq) == (direction, seq)
        if name == "(ack/nak)":
            assert item.kind in (Kind.ACK, Kind.NAK)
            continue
        assert (item.kind, item.name) == (Kind.MESSAGE, name)
        assert item.params.keys() == params.keys()
        for param, value in item.params.items():
            wanted = params[param]
            if isinstance(wanted, str):
                names = decoder.dictionaries.known[recorded.NODEID].enumeration_for(param)
                assert names is not None
                assert names.value_of(wanted) == value
            else:
                assert (value & 0xFFFFFFFF if isinstance(value, int) else value) == wanted
