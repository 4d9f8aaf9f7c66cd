"""TLS whose bytes two may take: the loop, and the stop lane while the loop is held.

asyncio keeps TLS to itself: what a client has sent cannot be read beside its loop. Here the state of TLS has
a lock, and whoever takes bytes from the socket has it process them (docs/adr/0016-stop-path.md).
"""

import asyncio
import contextlib
import socket
import ssl
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.server.stop_lane import EncryptedTransport, FindStop
from nodes.support.errors import CanductorError

READ_BYTES: Final = 16_384
"""At a time: one record of the longest kind, or 700 of one byte, which take 1 to 2 ms."""
READS_PER_ROUND: Final = 4
"""Of all connections of a server, in one round of the loop; a handshake takes about 1 ms, too."""
WAITING_MAX: Final = 262_144
"""Decrypted bytes that wait to be taken; then no more are read."""


def _nothing() -> None:
    pass


class ReadTurns:
    """Bounds what all connections of a server decrypt in one round of the loop that takes the turns."""

    def __init__(self) -> None:
        self._taken = 0

    def take(self) -> bool:
        """Return whether this round has a turn left, and take it."""
        if self._taken == 0:
            asyncio.get_running_loop().call_soon(self._begin_round)  # before what the next round finds ready
        if self._taken >= READS_PER_ROUND:
            return False
        self._taken += 1
        return True

    def _begin_round(self) -> None:
        self._taken = 0


class TlsServer:
    """TLS 1.2 or later with the chain and key of two PEM files; raises CanductorError."""

    def __init__(self, certificate: Path, private_key: Path) -> None:
        self._turns = ReadTurns()
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            self._context.load_cert_chain(certificate, private_key)
        except (OSError, ssl.SSLError) as error:
            raise CanductorError(
                f"the certificate {certificate} or its key cannot be used: {error}"
            ) from None

    def begin(self, opened: socket.socket) -> "TlsState":
        """Return the state of TLS over OPENED, a non-blocking socket of its own."""
        return TlsState(opened, self._context, self._turns)


class TlsState:
    """The server's end of a TLS connection over OPENED, a non-blocking socket of its own; for any thread.

    On the loop it reads in its TURNS.
    """

    def __init__(self, opened: socket.socket, context: ssl.SSLContext, turns: ReadTurns) -> None:
        self.context = context
        self.turns = turns
        self.socket = opened
        self._lock = threading.RLock()
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=True)
        self._waiting = bytearray()
        self.is_ready = False
        """Whether the handshake is done."""
        self.error: Exception | None = None
        """Why nothing more will come, unless the client has ended it."""
        self.ended = False
        """Whether nothing more will come."""
        self._raw: asyncio.Transport | None = None
        self._on_news = _nothing

    async def serve(
        self,
        make_protocol: Callable[[], asyncio.BaseProtocol],
        opened: socket.socket,
        handshake_s: float,
    ) -> None:
        """Have the running loop serve OPENED, accepted; return when the handshake is done, in HANDSHAKE_S.

        Raises OSError, TimeoutError included, with the connection closed.
        """
        loop = asyncio.get_running_loop()
        transport = TlsTransport(loop, self, make_protocol)
        await loop.connect_accepted_socket(lambda: _Carrier(transport), opened)
        try:
            async with asyncio.timeout(handshake_s):
                await transport.ready
        except BaseException:
            transport.abort()
            raise

    def carried_by(self, raw: asyncio.Transport, on_news: Callable[[], None]) -> None:
        """Have RAW send, from now on; ON_NEWS is called when ``find_in`` has taken something."""
        with self._lock:
            self._raw, self._on_news = raw, on_news

    def find_in(self, find: FindStop) -> str | None:
        """Read from the socket and return FIND of the decrypted bytes that were not taken yet; in any thread.

        A handshake that is under way is continued.
        """
        with self._lock:
            shakes_hands = not self.is_ready
            news = self.receive()
            if news and shakes_hands and (self._raw is None or not self._raw.get_write_buffer_size()):
                with contextlib.suppress(OSError):
                    self.socket.sendall(self._outgoing.read())  # of the handshake: there is room for it
        if news:
            self._on_news()
        return find(self.waiting)

    def receive(self) -> bool:
        """Take a bounded part of what the socket has, and decrypt it; return whether there was news."""
        with self._lock:
            if self.ended or len(self._waiting) >= WAITING_MAX:
                return False
            try:
                data = self.socket.recv(READ_BYTES)
            except (BlockingIOError, InterruptedError):
                return False
            except OSError as error:
                self._end(error)
                return True
            if data:
                self._incoming.write(data)
            else:
                self._incoming.write_eof()
            try:
                self._process()
            except ssl.SSLZeroReturnError:
                self._end(None)
            except OSError as error:  # errors of TLS are OSErrors as well
                self._end(error if data or not self.is_ready else None)
            return True

    def _process(self) -> None:
        try:
            if not self.is_ready:
                self._tls.do_handshake()
                self.is_ready = True
            while True:
                if not (data := self._tls.read(READ_BYTES)):
                    self._end(None)
                    return
                self._waiting += data
        except ssl.SSLWantReadError:
            pass

    def _end(self, error: Exception | None) -> None:
        self.ended, self.error = True, error

    @property
    def waiting(self) -> bytes:
        """What was decrypted and not taken."""
        with self._lock:
            return bytes(self._waiting)

    def take(self) -> bytes:
        """Return what was decrypted, once."""
        with self._lock:
            data = bytes(self._waiting)
            self._waiting.clear()
            return data

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Encrypt DATA; raises OSError when TLS has failed."""
        with self._lock:
            self._tls.write(data)

    def close(self) -> None:
        """Tell the client that nothing more will come; the answer is not waited for."""
        with self._lock:
            if self.is_ready:
                try:
                    self._tls.unwrap()
                except OSError:  # it waits for the client's
                    return

    def release(self) -> None:
        """Let go of the socket."""
        with self._lock:
            self.socket.close()

    def send(self) -> None:
        """Send what is to be sent; on the loop."""
        with self._lock:
            if self._raw is not None and (data := self._outgoing.read()):
                self._raw.write(data)


class TlsTransport(EncryptedTransport):
    """Carries PROTOCOL over TLS, once the handshake is done; ``ready`` is set then, or has its error."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        state: TlsState,
        make_protocol: Callable[[], asyncio.BaseProtocol],
    ) -> None:
        super().__init__()
        self.ready: asyncio.Future[None] = loop.create_future()
        self._loop = loop
        self._state = state
        self._make_protocol = make_protocol
        self._protocol: asyncio.BaseProtocol | None = None
        self._raw: asyncio.Transport
        self._paused = False
        self._closing = False
        self._lost = False

    # ------------------------------------------------------------------------------- beside the loop

    def find_in(self, find: FindStop) -> str | None:
        """Return what FIND finds in what the client has sent and nobody has taken; in any thread."""
        return self._state.find_in(find)

    def _handle_news(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._deliver)

    # ----------------------------------------------------------------------------- what carries it

    def carried_by(self, raw: asyncio.Transport) -> None:
        """Begin: RAW sends what is encrypted; what comes is read here."""
        # Not at once: asyncio of 3.11.2 (Debian 12) begins to read after connection_made, whatever was paused
        # in there. The pause is ahead of what it might read until then.
        self._loop.call_soon(raw.pause_reading)
        self._raw = raw
        self._state.carried_by(raw, self._handle_news)
        self._loop.add_reader(self._state.socket, self._readable)
        self._readable()  # the handshake may have begun

    def lost(self, error: Exception | None) -> None:
        """End: the connection is gone."""
        self._closing = self._lost = True
        self._read_no_more()
        self._state.release()
        if not self.ready.done():
            self.ready.set_exception(error or ConnectionResetError("the client left during the handshake"))
        if self._protocol is not None:
            self._protocol.connection_lost(error or self._state.error)

    def _read_no_more(self) -> None:
        if self._state.socket.fileno() >= 0:
            self._loop.remove_reader(self._state.socket)

    def _readable(self) -> None:
        if self._state.turns.take():  # else the loop finds it readable again in its next round
            self._state.receive()
        self._deliver()

    def _deliver(self) -> None:
        """Let the protocol have what has come."""
        if self._closing:
            return
        self._state.send()
        if self._state.is_ready and self._protocol is None:
            self._protocol = self._make_protocol()
            self._protocol.connection_made(self)
            self.ready.set_result(None)
        if self._protocol is not None and not self._paused and (data := self._state.take()):
            _hand_over(self._protocol, data)
        if self._state.ended and not self._closing and not self._state.waiting:
            self._read_no_more()
            if self._state.error is None:
                _say_end(self._protocol)
            self.close()

    # ------------------------------------------------------------------------------- asyncio.Transport

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return what is known of the connection, as of any other."""
        return self._state.context if name == "sslcontext" else self._raw.get_extra_info(name, default)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Carry PROTOCOL from now on."""
        self._protocol = protocol

    def get_protocol(self) -> asyncio.BaseProtocol:
        """Return what is carried."""
        assert self._protocol is not None
        return self._protocol

    def is_closing(self) -> bool:
        """Return whether it is closed, or about to be."""
        return self._closing or self._raw.is_closing()

    def is_reading(self) -> bool:
        """Return whether the protocol gets what comes."""
        return not (self._paused or self.is_closing())

    def pause_reading(self) -> None:
        """Let what comes wait."""
        if self.is_reading():
            self._paused = True
            self._read_no_more()

    def resume_reading(self) -> None:
        """Let it come again."""
        if self._paused and not self.is_closing():
            self._paused = False
            self._loop.add_reader(self._state.socket, self._readable)
            self._loop.call_soon(self._deliver)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send DATA, encrypted."""
        if self.is_closing() or not data:
            return
        try:
            self._state.write(data)
        except OSError:  # nothing can be said to this client any more
            self.abort()
            return
        self._state.send()

    def can_write_eof(self) -> bool:
        """Return that TLS is ended as a whole."""
        return False

    def get_write_buffer_size(self) -> int:
        """Return how many bytes wait to be sent."""
        return self._raw.get_write_buffer_size()

    def get_write_buffer_limits(self) -> tuple[int, int]:
        """Return when the protocol is told to go on, and to wait."""
        return self._raw.get_write_buffer_limits()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Tell the protocol to wait when so many bytes wait to be sent."""
        self._raw.set_write_buffer_limits(high, low)

    def close(self) -> None:
        """Send what waits, and end it."""
        if not self.is_closing():
            self._closing = True
            self._read_no_more()
            self._state.close()
            self._state.send()
            self._raw.close()

    def abort(self) -> None:
        """End it at once, unless it is gone."""
        self._closing = True
        self._read_no_more()
        if not self._lost:  # asyncio would end it again if it went while there was something to be sent
            self._raw.abort()


class _Carrier(asyncio.Protocol):
    """The end of the raw connection: all but reading."""

    def __init__(self, transport: TlsTransport) -> None:
        self._transport = transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport.carried_by(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport.lost(exc)

    def pause_writing(self) -> None:
        if self._transport.ready.done():
            self._transport.get_protocol().pause_writing()

    def resume_writing(self) -> None:
        if self._transport.ready.done():
            self._transport.get_protocol().resume_writing()


def _hand_over(protocol: asyncio.BaseProtocol, data: bytes) -> None:
    """Let PROTOCOL have DATA in its own way."""
    if isinstance(protocol, asyncio.BufferedProtocol):
        while data:
            room = memoryview(protocol.get_buffer(len(data)))
            size = min(len(room), len(data))
            room[:size] = data[:size]
            protocol.buffer_updated(size)
            data = data[size:]
    elif isinstance(protocol, asyncio.Protocol):
        protocol.data_received(data)


def _say_end(protocol: asyncio.BaseProtocol | None) -> None:
    """Tell PROTOCOL that the client sends nothing more."""
    if isinstance(protocol, asyncio.Protocol | asyncio.BufferedProtocol):
        protocol.eof_received()
