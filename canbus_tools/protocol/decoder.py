"""Decodes the frames of one CAN bus to named messages. Sans-IO.

``BusDecoder.feed`` takes every frame of a bus in order and returns the messages that it completes: usually
none (a block takes several frames), sometimes several. It never raises; its memory is bounded by the 255
nodes of a bus.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from canbus_tools.protocol import decoded as shapes
from canbus_tools.protocol.blocks import BlockStream, Noise
from canbus_tools.protocol.decoded import Decoded, FrameShape, Kind, MessageShape, OutputShape, Shape
from canbus_tools.protocol.dictionaries import DictionarySource
from canbus_tools.protocol.error_frames import error_frame
from canbus_tools.protocol.flow import EMPTY_SIZE, SEQUENCE_MASK
from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.protocol.protocol import ADMIN_FRAMES, SIGNAL_FRAMES, Direction, frame_format, owner_of
from canbus_tools.protocol.traffic import NodeTraffic
from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary
from nodes.dictionary.message_format import MessageFormat, Value
from nodes.dictionary.parts import OutputFormat
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID, DATA_NODEID_MAX, UUID_SIZE

AnyShape = MessageShape | OutputShape
_FRAME_SHAPES: Final = {format_.name: FrameShape(format_) for format_ in (*ADMIN_FRAMES, *SIGNAL_FRAMES)}
_OTHER_SHAPES: Final = {
    FrameKind.DATA: shapes.OTHER,
    FrameKind.EXTENDED: shapes.OTHER_EXTENDED,
    FrameKind.REMOTE: shapes.OTHER_REMOTE,
    FrameKind.FD: shapes.OTHER_FD,
}
_NAMES_NODE: Final = ("set_nodeid", "set_nodeid_bootloader", "node_is_here")
_new: Final = tuple.__new__  # NamedTuple's own constructor is a Python function around it
_DATA: Final = FrameKind.DATA
_TO_NODE: Final = Direction.TO_NODE
_FROM_NODE: Final = Direction.FROM_NODE
_MESSAGE: Final = Kind.MESSAGE


class BusDecoder:
    """Decodes one bus; for one thread."""

    def __init__(self, dictionaries: DictionarySource | None = None) -> None:
        self.dictionaries = DictionarySource() if dictionaries is None else dictionaries
        self.other_frames = 0
        """Frames that are not of this protocol."""
        self.error_frames = 0
        self._nodes: dict[int, NodeTraffic] = {}
        self._streams: dict[int, _Stream] = {}

    @property
    def nodes(self) -> Mapping[int, NodeTraffic]:
        """The nodes seen so far by node id, with their counters."""
        return self._nodes

    def feed(self, frame: Frame) -> Sequence[Decoded]:
        """Take the next frame; returns what it said or completed."""
        stream = self._streams.get(frame[1])
        if stream is None or frame[3] is not _DATA:
            return self._feed_rare(frame)
        return stream.feed(frame)

    def flush(self) -> list[Decoded]:
        """End: return what can still be read of blocks that were never completed."""
        return [said for stream in self._streams.values() for said in stream.flush()]

    # ------------------------------------------------------------------------------------------ other frames

    def _feed_rare(self, frame: Frame) -> Sequence[Decoded]:
        if frame.kind is FrameKind.ERROR:
            self.error_frames += 1
            shape, values = error_frame(frame.can_id, frame.data)
            return [_whole(frame, Kind.ERROR, shape, values)]
        if frame.kind is FrameKind.DATA:
            owner = owner_of(frame.can_id)
            if owner is not None:
                return self._stream_of(frame.can_id, *owner).feed(frame)
            known = frame_format(frame.can_id, frame.data)
            if known is not None:
                return self._feed_frame(frame, _FRAME_SHAPES[known.name], known.direction)
        self.other_frames += 1
        shape = _OTHER_SHAPES.get(frame.kind, shapes.OTHER)
        return [_whole(frame, Kind.OTHER, shape, (frame.can_id, frame.data))]

    def _feed_frame(self, frame: Frame, shape: FrameShape, direction: Direction) -> Sequence[Decoded]:
        values = shape.read(frame.data)
        params = dict(zip(shape.names, values, strict=True))
        nodeid = params.get("nodeid", params.get("origin"))
        uuid = params.get("uuid")
        if not isinstance(nodeid, int) or not 1 <= nodeid <= DATA_NODEID_MAX:
            nodeid = None
        if nodeid is not None and isinstance(uuid, bytes) and shape.name in _NAMES_NODE:
            self._name_node(nodeid, uuid)
        kind = Kind.ADMIN if frame.can_id in (ADMIN_ID, ADMIN_RESPONSE_ID) else Kind.SIGNAL
        return [_whole(frame, kind, shape, values, nodeid=nodeid, direction=direction)]

    # ------------------------------------------------------------------------------------------------- nodes

    def _node(self, nodeid: int) -> NodeTraffic:
        node = self._nodes.get(nodeid)
        if node is None:
            node = self._nodes[nodeid] = NodeTraffic(nodeid)
            node.take_dictionary(self.dictionaries)
        return node

    def _stream_of(self, can_id: int, nodeid: int, direction: Direction) -> "_Stream":
        stream = self._streams.get(can_id)
        if stream is None:
            kind = _CommandStream if direction is Direction.TO_NODE else _ResponseStream
            stream = self._streams[can_id] = kind(self._node(nodeid), self.dictionaries)
        return stream

    def _name_node(self, nodeid: int, uuid: bytes) -> None:
        node = self._node(nodeid)
        if node.uuid not in (None, uuid.hex()):  # another board: nothing of what was learnt holds for it
            self.dictionaries.forget(nodeid)
            node.take_dictionary(self.dictionaries)
            node.flow.restart()
        node.uuid = uuid.hex()


def _whole(
    frame: Frame,
    kind: Kind,
    shape: Shape,
    values: Sequence[Value],
    *,
    nodeid: int | None = None,
    direction: Direction = Direction.ANY,
) -> Decoded:
    """Return what a frame says by itself."""
    return Decoded(frame.time_s, frame.channel, nodeid, direction, kind, -1, False, shape, values)


# ---------------------------------------------------------------------------------------------------- streams


class _Stream(BlockStream):
    """One direction of one node's data."""

    direction: Direction

    def __init__(self, node: NodeTraffic, dictionaries: DictionarySource) -> None:
        super().__init__(node.to_node if self.direction is Direction.TO_NODE else node.from_node)
        self._node = node
        self._dictionaries = dictionaries
        self._known = dictionaries.known
        self._dictionary: Dictionary | None = None
        self._shapes: dict[MessageFormat | OutputFormat, AnyShape] = {}

    def _take(self, found: Sequence[bytes], frame: Frame) -> Sequence[Decoded]:
        out: list[Decoded] = []
        for block in found:
            if type(block) is Noise:
                self._way.noises += 1
                self._way.invalid_bytes += len(block)
                out.append(self._said(frame, Kind.NOISE, shapes.NOISE, (len(block), bytes(block))))
            else:
                self._way.blocks += 1
                self._block(out, block, frame)
        return out

    def _block(self, out: list[Decoded], block: bytes, frame: Frame) -> None:
        raise NotImplementedError

    def _said(
        self,
        frame: Frame,
        kind: Kind,
        shape: Shape,
        values: Sequence[Value],
        *,
        seq: int = -1,
        repeated: bool = False,
    ) -> Decoded:
        nodeid, direction = self._node.nodeid, self.direction
        return Decoded(frame.time_s, frame.channel, nodeid, direction, kind, seq, repeated, shape, values)

    def _current(self) -> Dictionary:
        """Return the node's dictionary, the two fixed messages without one; drops shapes of another."""
        dictionary = self._known.get(self._node.nodeid, BOOTSTRAP)
        if dictionary is not self._dictionary:
            self._dictionary = dictionary
            self._shapes = {}
        return dictionary

    def _learns_from(self, content: bytes, time_s: float) -> bool:
        """Take an unreadable block; return whether a dictionary was found that explains it."""
        before = self._known.get(self._node.nodeid)
        known = self._dictionaries.unread(self._node.nodeid, self.direction, content, time_s)
        if before is not self._known.get(self._node.nodeid):
            self._node.take_dictionary(self._dictionaries)
        return known

    def _shape(self, format_: MessageFormat | OutputFormat, dictionary: Dictionary) -> AnyShape:
        shape: AnyShape
        if isinstance(format_, OutputFormat):
            shape = OutputShape(format_)
        else:
            shape = MessageShape(format_, dictionary)
        self._shapes[format_] = shape
        return shape


class _CommandStream(_Stream):
    direction = Direction.TO_NODE

    def _block(self, out: list[Decoded], block: bytes, frame: Frame) -> None:
        node = self._node
        time_s, channel = frame[0], frame[4]
        seq = block[1] & SEQUENCE_MASK
        repeated = node.flow.sent(block, time_s)
        content = block[2:-3]
        if not content:
            out.append(self._said(frame, Kind.MESSAGE, shapes.EMPTY, (), seq=seq, repeated=repeated))
            return
        dictionary = self._current()
        at, size = 0, len(content)
        while at < size:
            found = dictionary.command_at(content, at)
            shape = found and (self._shapes.get(found[0]) or self._shape(found[0], dictionary))
            read = found and shape and shape.read(content, found[1])
            if not read or not shape:
                if self._learns_from(content, time_s) and not at:
                    dictionary = self._current()
                    continue
                self._way.unknown_messages += 1
                rest = (content[at:],)
                out.append(self._said(frame, _MESSAGE, shapes.UNKNOWN, rest, seq=seq, repeated=repeated))
                return
            values, at = read
            if not repeated:
                self._way.messages += 1
            said = (time_s, channel, node.nodeid, _TO_NODE, _MESSAGE, seq, repeated, shape, values)
            out.append(_new(Decoded, said))


class _ResponseStream(_Stream):
    direction = Direction.FROM_NODE

    def _block(self, out: list[Decoded], block: bytes, frame: Frame) -> None:
        node, time_s = self._node, frame[0]
        node.last_heard_s = time_s
        seq = block[1] & SEQUENCE_MASK
        refused = node.flow.answered(block, time_s)
        if len(block) == EMPTY_SIZE:
            kind, shape = (Kind.NAK, shapes.NAK) if refused else (Kind.ACK, shapes.ACK)
            out.append(self._said(frame, kind, shape, (seq,), seq=seq))
            return
        self._response(out, block[2:-3], frame, seq)

    def _response(self, out: list[Decoded], content: bytes, frame: Frame, seq: int) -> None:
        node, time_s, channel = self._node, frame[0], frame[4]
        dictionary = self._current()
        found = dictionary.response_at(content)
        said = found and (self._shapes.get(found[0]) or self._shape(found[0], dictionary))
        read = found and said and said.read(content, found[1])
        if not read or not said or read[1] != len(content):
            if self._learns_from(content, time_s):
                self._response(out, content, frame, seq)
                return
            self._way.unknown_messages += 1
            out.append(self._said(frame, _MESSAGE, shapes.UNKNOWN, (content,), seq=seq))
            return
        self._way.messages += 1
        row = (time_s, channel, node.nodeid, _FROM_NODE, _MESSAGE, seq, False, said, read[0])
        out.append(_new(Decoded, row))
        if said.name in _TELLING:
            self._learn(said, read[0])

    def _learn(self, shape: Shape, values: Sequence[Value]) -> None:
        """Evaluate a response with information about the node."""
        params = dict(zip(shape.names, values, strict=True))
        offset, data, uuid = params.get("offset"), params.get("data"), params.get("canbus_uuid")
        if isinstance(offset, int) and isinstance(data, bytes):
            self._dictionaries.hear(self._node.nodeid, offset, data)
            self._node.take_dictionary(self._dictionaries)
        elif isinstance(uuid, bytes) and len(uuid) == UUID_SIZE:
            self._node.uuid = uuid.hex()


_TELLING: Final = {"identify_response", "canbus_id"}
