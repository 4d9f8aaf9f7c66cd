"""The server's sockets: where it listens, and whom it lets in (asyncio)."""

import asyncio
import functools
import socket
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict, dataclass, fields
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import Encoder, Encoding
from coordinator.ipc.protocol.methods import ApiError, Caller, Method, Registry
from coordinator.ipc.protocol.peer import may_use, peer_of
from coordinator.ipc.server.auth import Grant, LoginThrottle, Tokens, digest_of, stamp_of
from coordinator.ipc.server.connection import Connection
from coordinator.ipc.server.fair_scheduler import FairScheduler
from coordinator.ipc.server.publisher import Publisher
from coordinator.ipc.server.session import Session, SessionContext, SessionCounters
from coordinator.ipc.server.session_methods import add_session_methods
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.tcp_listener import HANDSHAKES_MAX, TcpListener
from coordinator.ipc.server.unix_socket import UnixListener
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

if TYPE_CHECKING:
    from coordinator.ipc.server.tls_transport import TlsServer

TOKENS_CHECK_S: Final = 1.0
"""Between looks at whether the tokens' file has changed."""
STOP_METHOD: Final = "machine.emergency_stop"
REFUSALS_MAX: Final = 32
"""Connections beyond the most that still get the reason; further ones are just closed."""


@dataclass(frozen=True, slots=True)
class ExternalGrant:
    """What a client may do that connected to another server, such as the live page's."""

    grant: Grant
    token: bytes | None
    """Digest of the token behind it: when that is revoked the client is disconnected. None: there is none."""


@dataclass(frozen=True, slots=True)
class StopCall:
    """A client's emergency stop that came outside of any session."""

    method: Method
    caller: Caller
    params: dict[str, Any]

    @property
    def who(self) -> str | None:
        """Who stops the machine; in any thread."""
        return self.method.stops(self.caller, self.params)

    def carry_out(self) -> Value:
        """Stop it, and return the method's result; on the loop."""
        result = self.method.call(self.caller, self.params)
        assert not isinstance(result, Awaitable), "urgent methods are plain functions"
        return result


def _ignore(_: str) -> None:
    pass


class IpcServer:
    """Serves the methods of REGISTRY, and STATE, to front ends; lives on the loop that starts it.

    ON_NOTICE gets sentences for the machine's owner. STOP_LANE finds emergency stops while the loop is held.
    """

    def __init__(
        self,
        registry: Registry,
        state: StateTree,
        settings: IpcSettings,
        *,
        on_notice: Callable[[str], None] = _ignore,
        stop_lane: StopLane | None = None,
    ) -> None:
        add_session_methods(registry)
        self._settings = settings
        self._encoder = Encoder()
        self._context = SessionContext(registry, Publisher(state, self._encoder), settings.limits)
        self._unix: UnixListener | None = None
        self._listener: TcpListener | None = None
        self._connections: set[Connection] = set()
        self._leaving: dict[Connection, None] = {}
        """Have left, the first one first: their stops are not read yet. They count against no limit."""
        self._throttle = LoginThrottle()
        self._on_notice = on_notice
        self._tokens: Tokens | None = None
        self._digests: dict[Connection, bytes] = {}  # digests of the tokens that clients came in with
        self._tcp: set[Connection] = set()
        """Connections that count against ``tcp_connections_max``."""
        self.stop_lane = stop_lane or StopLane()
        self._watch: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._scheduler: FairScheduler | None = None
        self._sessions = 0
        self._refused = 0
        self._unsendable = 0  # notifications that no message can carry
        self._closed_totals = SessionCounters()
        self.tcp_port: int | None = None
        """The port, once open; of use where the settings say 0, any port."""
        self.tcp_addresses: list[str] = []
        """The IP addresses that the port is open on; 0.0.0.0 and :: stand for all."""

    # ------------------------------------------------------------------------------------------- life

    async def start(self) -> None:
        """Open the sockets; raises CanductorError with all closed."""
        scheduler = self._scheduler = FairScheduler()
        self._loop = asyncio.get_running_loop()
        try:
            if self._settings.tokens is not None:
                self._tokens = await asyncio.to_thread(Tokens.read, self._settings.tokens)
            if self._settings.unix_path is not None:
                await self._open_unix(self._settings.unix_path, scheduler)
            if self._settings.tcp is not None:
                await self._open_tcp(self._settings.tcp, scheduler)
            path = self._settings.tokens if self._settings.tcp is None else self._settings.tcp.tokens
            if path is not None and self._tokens is not None:
                self._watch = asyncio.ensure_future(self._watch_tokens(path, self._tokens))
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Disconnect every client and close the sockets."""
        if self._watch is not None:
            self._watch.cancel()
        for listener in (self._unix, self._listener):
            if listener is not None:
                listener.close()
        for connection in list(self._connections):
            connection.session.end(EndReason("closing", "the server is closing"))
            connection.flush()
            connection.transport.close()
        for connection in list(self._leaving):
            connection.forget_rest()
        await asyncio.sleep(0)

    def notify(self, event: str, values: Mapping[str, Value]) -> None:
        """Send EVENT ("log", "gcode.reply") to every client that listens to it; nothing is sent in here."""
        message: dict[str, Value] = {"event": event, "values": dict(values)}
        encoded: dict[Encoding, bytes] = {}
        for connection in self._connections:
            session = connection.session
            if not session.listens.matches(event):
                continue
            encoding = session.encoding
            if (data := encoded.get(encoding)) is None:
                try:
                    data = encoded[encoding] = self._encoder.message(encoding, message)
                except ValueError:  # who notifies has other things to do than to fail for this
                    self._unsendable += 1
                    return
            connection.notify(event, data)

    def figures(self) -> dict[str, Value]:
        """Return how many clients there are, and the counters of all messages since the start."""
        counted = asdict(self._closed_totals)
        for connection in (*self._connections, *self._leaving):
            for name, value in asdict(connection.session.counters).items():
                counted[name] += value
        return {
            "connections": len(self._connections),
            "refused_connections": self._refused + (0 if self._listener is None else self._listener.refused),
            "unsendable": self._unsendable + self._context.publisher.unsendable,
            **counted,
        }

    # ---------------------------------------------------------------------------------------- sockets

    async def _open_unix(self, path: Path, scheduler: FairScheduler) -> None:
        self._unix = UnixListener(
            lambda: Connection(self._admit_unix, self._leave, self._drop, scheduler),
            self.stop_lane,
            self._find_stop,
        )
        await self._unix.open(path)

    async def _open_tcp(self, tcp: TcpSettings, scheduler: FairScheduler) -> None:
        tls = await asyncio.to_thread(_tls_of_tcp, tcp)
        self._tokens = await asyncio.to_thread(Tokens.read, tcp.tokens)
        most = self._settings.tcp_connections_max
        listener = self._listener = TcpListener(
            lambda: Connection(self._admit_tcp, self._leave, self._drop, scheduler),
            tls,
            handshakes_max=min(HANDSHAKES_MAX, most),
            may_enter=lambda entering: entering + len(self._tcp) < most + REFUSALS_MAX,
            stop_lane=self.stop_lane,
            find_stop=self._find_stop_over_tcp,
        )
        try:
            await listener.open(tcp.host, tcp.port)
        except OSError as error:
            raise CanductorError(
                f"port {tcp.port} of {tcp.host} cannot be opened: {error.strerror or error}"
            ) from None
        except UnicodeError:  # an empty label, or one of more than 63 characters
            raise CanductorError(
                f"port {tcp.port} of {tcp.host} cannot be opened: no host can have this name"
            ) from None
        self.tcp_port = listener.addresses[0][1]
        self.tcp_addresses = [address for address, _ in listener.addresses]

    # ----------------------------------------------------------------------------------------- tokens

    async def _watch_tokens(self, path: Path, tokens: Tokens) -> None:
        """Read PATH again when it changes. While it cannot be read no token lets anybody in."""
        known, failure = tokens.stamp, ""
        while True:
            await asyncio.sleep(TOKENS_CHECK_S)
            if await asyncio.to_thread(stamp_of, path) == known and not failure:
                continue
            try:
                tokens = await asyncio.to_thread(Tokens.read, path)
            except CanductorError as error:
                if str(error) != failure:
                    self._on_notice(f"{error}; until then no token is accepted")
                self._tokens, failure = None, str(error)
                continue
            self._tokens, known, failure = tokens, tokens.stamp, ""
            self._on_notice(f"the tokens of {path.name} were read again")
            self._end_revoked(tokens)

    def _end_revoked(self, tokens: Tokens) -> None:
        """End the clients whose token is not in TOKENS any more, or has a lower scope."""
        for connection, token in list(self._digests.items()):
            grant, caller = tokens.grant_of(token), connection.session.caller
            if caller is not None and (grant is None or grant.scope < caller.scope):
                connection.session.end(EndReason("bad_token", "the token was revoked"))
                connection.flush()

    # ---------------------------------------------------------------------------------------- clients

    @property
    def limits(self) -> Limits:
        """What one client may cost."""
        return self._context.limits

    def adopt(
        self, transport: asyncio.Transport, address: str, check_key: Callable[[str], ExternalGrant | None]
    ) -> Connection:
        """Take a client that came by another way, such as the live page's; TRANSPORT carries JSON lines.

        What it gives as its token in the hello goes to CHECK_KEY, which returns what it may do.
        """

        def admit(_: asyncio.Transport, connection: Connection) -> Session:
            def check(key: str) -> Grant | None:
                adopted = check_key(key)
                if adopted is None:
                    return None
                if adopted.token is not None:
                    self._digests[connection] = adopted.token
                return adopted.grant

            return self._session(connection, address, check)

        assert self._scheduler is not None, "the server is not started"
        connection = Connection(admit, self._leave, self._drop, self._scheduler)
        connection.connection_made(transport)
        return connection

    def stop_call(self, client: str, address: str, grant: Grant, params: Mapping[str, Any]) -> StopCall:
        """Return the emergency stop of CLIENT at ADDRESS, which has GRANT; in any thread.

        Raises ApiError ``not_allowed``. What is wrong in PARAMS is ignored.
        """
        method = self._context.registry.methods[STOP_METHOD]
        if method.scope > grant.scope:
            needed, has = method.scope.word, grant.scope.word
            raise ApiError("not_allowed", f"{STOP_METHOD} needs the scope {needed}, this client has {has}")
        peer = f"{address}, token {grant.name}" if grant.name else address
        usable, _ = method.check_urgent(dict(params))
        return StopCall(method, Caller(f"{client} ({peer})", grant.scope), usable)

    def check_token(self, token: str, address: str) -> Grant:
        """Return what TOKEN gives to somebody at ADDRESS; counts failures.

        Raises ApiError ``too_many_failures``, ``bad_token``.
        """
        if (wait_s := self._lockout_s(address)) > 0:
            raise ApiError("too_many_failures", _lockout_sentence(address, wait_s))
        grant = self._grant(token, address)
        if grant is None:
            raise ApiError("bad_token", "the token is not known here")
        return grant

    def grant_of(self, token: bytes) -> Grant | None:
        """Return what the token with the digest TOKEN gives now, None if nothing."""
        return None if self._tokens is None else self._tokens.grant_of(token)

    def _grant(self, token: str, address: str) -> Grant | None:
        """Return what TOKEN gives; None: nothing, which counts as a failure of ADDRESS if it has one."""
        if self._tokens is None:
            return None
        grant = self._tokens.check(token)
        if grant is None and address:
            self._throttle.failed(address, asyncio.get_running_loop().time())
        return grant

    def _lockout_s(self, address: str) -> float:
        return self._throttle.lockout_s(address, asyncio.get_running_loop().time())

    def _admit_unix(self, transport: asyncio.Transport, connection: Connection) -> Session:
        pid, uid = peer_of(transport.get_extra_info("socket"))
        session = self._session(connection, f"uid {uid}, pid {pid}", self._token_check(connection, ""))
        session.granted = self._settings.unix_scope
        if not may_use(uid):
            self._refuse(session, EndReason("not_allowed", f"this socket is not for the user with uid {uid}"))
        return session

    def _admit_tcp(self, transport: asyncio.Transport, connection: Connection) -> Session:
        address = str((transport.get_extra_info("peername") or ("unknown",))[0])
        session = self._session(
            connection,
            address,
            self._token_check(connection, address),
            functools.partial(self._find_token, address),
        )
        wait_s = self._lockout_s(address)
        if len(self._tcp) >= self._settings.tcp_connections_max:
            self._refuse(session, EndReason("busy", "there are too many connections over TCP; close others"))
        elif wait_s > 0:
            self._refuse(session, EndReason("too_many_failures", _lockout_sentence(address, wait_s)))
        self._tcp.add(connection)
        return session

    def _find_stop(self, opened: socket.socket, unread: bytes) -> str | None:
        """Return who stops the machine with the UNREAD bytes of a new connection over the Unix socket."""
        if not unread:  # or it has closed
            return None
        pid, uid = peer_of(opened)
        if not may_use(uid):
            return None
        session = Session(
            self._context, 0.0, number=0, peer=f"uid {uid}, pid {pid}", granted=self._settings.unix_scope
        )
        return session.find_stop(unread, self.stop_lane.goes_on)

    def _find_stop_over_tcp(self, address: str, unread: bytes) -> str | None:
        """Return who stops the machine with the UNREAD bytes of a new connection over TCP from ADDRESS."""
        find = functools.partial(self._find_token, address)
        session = Session(self._context, 0.0, number=0, peer=address, granted=None, find_token=find)
        return session.find_stop(unread, self.stop_lane.goes_on)

    def _find_token(self, address: str, token: str) -> Grant | None:
        """Return what TOKEN gives to somebody at ADDRESS, in any thread: the loop counts when it reads it."""
        tokens, loop = self._tokens, self._loop
        if tokens is None or loop is None or self._throttle.lockout_s(address, loop.time()) > 0:
            return None
        return tokens.check(token)

    def _token_check(self, connection: Connection, address: str) -> Callable[[str], Grant | None]:
        """Return what looks at the token of CONNECTION's hello; failures count for ADDRESS, if it has one."""

        def check(token: str) -> Grant | None:
            grant = self._grant(token, address)
            if grant is not None:
                self._digests[connection] = digest_of(token)
            return grant

        return check

    def _session(
        self,
        connection: Connection,
        peer: str,
        check: Callable[[str], Grant | None],
        find_token: Callable[[str], Grant | None] | None = None,
    ) -> Session:
        self._sessions += 1
        now_s = asyncio.get_running_loop().time()
        session = Session(
            self._context,
            now_s,
            number=self._sessions,
            peer=peer,
            granted=None,
            check_token=check,
            find_token=find_token,
        )
        self._connections.add(connection)
        find_stop = functools.partial(session.find_stop, goes_on=self.stop_lane.goes_on)
        self.stop_lane.watch_transport(connection, connection.transport, find_stop)
        if len(self._connections) > self._settings.connections_max:
            self._refuse(session, EndReason("busy", "there are too many connections; close others"))
        if len(self._connections) > self._settings.connections_max + REFUSALS_MAX:
            connection.transport.abort()
        return session

    def _refuse(self, session: Session, fault: EndReason) -> None:
        self._refused += 1
        session.end(fault)

    def _leave(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._tcp.discard(connection)
        self._leaving[connection] = None
        if len(self._leaving) > self._settings.connections_max:
            # All may leave in one round. Who comes and leaves behind them takes rounds, and these have turns.
            next(iter(self._leaving)).forget_rest()

    def _drop(self, connection: Connection) -> None:
        del self._leaving[connection]
        self._digests.pop(connection, None)
        self.stop_lane.forget(connection)
        for field in fields(SessionCounters):
            total = getattr(self._closed_totals, field.name) + getattr(
                connection.session.counters, field.name
            )
            setattr(self._closed_totals, field.name, total)


def _lockout_sentence(address: str, wait_s: float) -> str:
    return f"too many wrong tokens from {address}; wait {wait_s:.0f} s"


# ------------------------------------------------------------------------------------------------- opening


def _tls_of_tcp(tcp: TcpSettings) -> "TlsServer | None":
    """Return how TCP is kept secret, None for plain loopback; raises CanductorError."""
    if tcp.certificate is not None and tcp.private_key is not None:
        from coordinator.ipc.server.tls_transport import TlsServer  # noqa: PLC0415 (it takes OpenSSL)

        return TlsServer(tcp.certificate, tcp.private_key)
    if not tcp.plain_on_loopback:
        raise CanductorError("TCP needs a certificate and its private key, or plain_on_loopback")
    if not _is_loopback(tcp.host):
        raise CanductorError(
            f"TCP without TLS is for loopback only, and {tcp.host} is not: 127.0.0.1 or ::1 is"
        )
    return None


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False  # a name may come to mean another address
