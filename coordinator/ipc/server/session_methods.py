"""The methods of the interface itself: hello, introspection, watching, cancelling."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from coordinator.ipc.protocol.limits import EndReason
from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Registry, Scope
from coordinator.ipc.server.state import costly_stars
from coordinator.support.values import Value
from nodes.support.terminal import printable

if TYPE_CHECKING:
    from coordinator.ipc.server.session import Session

API_VERSION: Final = 1
"""Rises when a program written against the version before would no longer work."""
HELLO: Final = "api.hello"
GLOB_LENGTH_MAX: Final = 128
STARS_MAX: Final = 16
"""In the middle of globs: each is a search in every path, on the loop that all share."""
CLIENT_NAME_MAX: Final = 64
RATE_HZ_MIN: Final = 0.01
RATE_HZ_MAX: Final = 50
"""Of the updates of one subscription."""

Handler = Callable[["Session", dict[str, Any], float], Value]
"""Gets the session, checked parameters and the time in s."""


def add_session_methods(registry: Registry) -> None:
    """Add the methods that every server has."""
    for method in _METHODS:
        if method.name not in registry.methods:  # one registry may serve again
            registry.add(method)


# ------------------------------------------------------------------------------------------------ handlers


def _hello(session: "Session", params: dict[str, Any], _now_s: float) -> Value:
    if session.caller is not None:
        raise ApiError("bad_params", "api.hello was called already")
    if params["version"] != API_VERSION:
        sentence = f"this server speaks version {API_VERSION}, not {params['version']}; update the older side"
        session.end(EndReason("bad_version", sentence))
        return None
    scope = _scope_of(session, params["token"])
    if scope is None:
        return None
    wanted = params["scope"]
    if wanted is not None:
        scope = min(scope, Scope[wanted.upper()])
    session.admit(Caller(f"{printable(params['client']) or 'unnamed'} ({session.peer})", scope))
    limits = session.context.limits
    return {
        "version": API_VERSION,
        "session": session.number,
        "scope": scope.word,
        "message_bytes_max": limits.message_bytes,
        "pending_requests_max": limits.pending_requests,
        "subscriptions_max": limits.subscriptions,
        "rate_hz_max": RATE_HZ_MAX,
    }


def _scope_of(session: "Session", token: str | None) -> Scope | None:
    """Return what the client may do; None when it may not even come in, and the session has ended."""
    if token is None:
        if session.granted is None:
            session.end(EndReason("no_token", "a token is needed here; give api.hello the parameter token"))
        return session.granted
    grant = None if session.check_token is None else session.check_token(token)
    if grant is None:
        session.end(EndReason("bad_token", "the token is not known here"))
        return None
    if grant.name:
        session.peer = f"{session.peer}, token {grant.name}"
    return grant.scope


def _methods(session: "Session", _params: dict[str, Any], _now_s: float) -> Value:
    return {"version": API_VERSION, "methods": session.context.registry.schema()}


def _ping(_session: "Session", _params: dict[str, Any], _now_s: float) -> Value:
    return {}


def _cancel(session: "Session", params: dict[str, Any], _now_s: float) -> Value:
    return {"found": session.cancel(params["id"])}


def _get(session: "Session", params: dict[str, Any], _now_s: float) -> Value:
    publisher = session.context.publisher
    taken = publisher.state.snapshot(publisher.filter(_globs(session, params, "fields")))
    return {"sequence": taken.sequence, "values": taken.values}


def _watch(session: "Session", params: dict[str, Any], now_s: float) -> Value:
    limits, publisher = session.context.limits, session.context.publisher
    if len(session.subscriptions) >= limits.subscriptions:
        raise ApiError(
            "busy", f"a client may watch {limits.subscriptions} times at once; api.unwatch ends one"
        )
    rate_hz = params["rate_hz"]
    wanted = publisher.filter(_globs(session, params, "fields"))
    taken = publisher.state.snapshot(wanted)
    number = session.subscribe(wanted, 1 / rate_hz, taken.sequence, now_s)
    return {"subscription": number, "sequence": taken.sequence, "values": taken.values}


def _unwatch(session: "Session", params: dict[str, Any], _now_s: float) -> Value:
    if session.subscriptions.pop(params["subscription"], None) is None:
        raise ApiError("bad_params", f"there is no subscription {params['subscription']}")
    return {}


def _listen(session: "Session", params: dict[str, Any], _now_s: float) -> Value:
    globs = _globs(session, params, "events")
    session.listens = session.context.publisher.filter(globs)
    return {}


def _globs(session: "Session", params: dict[str, Any], name: str) -> list[str]:
    globs: list[str] = params[name]
    most = session.context.limits.filters
    if len(globs) > most or any(type(g) is not str or len(g) > GLOB_LENGTH_MAX for g in globs):
        raise ApiError(
            "bad_params", f"{name} must be at most {most} strings of at most {GLOB_LENGTH_MAX} characters"
        )
    if costly_stars(globs) > STARS_MAX:
        raise ApiError(
            "bad_params",
            f"{name} must have at most {STARS_MAX} * that are not at the end of theirs; ask for more at once",
        )
    return globs


def _of_session(_caller: Caller, _params: dict[str, Any]) -> Value:
    """Fail: sessions perform these methods themselves."""
    raise ApiError("internal", "a method of the session was called without one")


# ---------------------------------------------------------------------------------------------- declared

IMMEDIATE_HANDLERS: Final[dict[str, Handler]] = {HELLO: _hello, "api.cancel": _cancel}
"""Performed while they are received."""
HANDLERS: Final[dict[str, Handler]] = {
    "api.methods": _methods,
    "api.ping": _ping,
    "state.get": _get,
    "api.watch": _watch,
    "api.unwatch": _unwatch,
    "api.listen": _listen,
}
"""Performed in their turn."""

_FIELDS: Final = Param(
    "fields", Kind.LIST, "globs of the fields; * stands for any characters", required=False, default=["*"]
)
_SEQUENCE: Final = Param("sequence", Kind.INT, "number of the last change that is in the values")
_VALUES: Final = Param("values", Kind.MAP, "every field that is wanted, by its path")


def _method(
    name: str, sentence: str, params: tuple[Param, ...] = (), returns: tuple[Param, ...] = ()
) -> Method:
    return Method(name, Scope.WATCH, sentence, _of_session, params, returns)


_METHODS: Final = (
    _method(
        HELLO,
        "Say which version is spoken and who is there; must be the first request.",
        (
            Param("version", Kind.INT, "of this interface"),
            Param("client", Kind.STR, "a name for people", required=False, default="", high=CLIENT_NAME_MAX),
            Param("token", Kind.STR, "needed on TCP", required=False, high=512),
            Param(
                "scope",
                Kind.STR,
                "to have no more than this",
                required=False,
                choices=tuple(scope.word for scope in Scope),
            ),
        ),
        (
            Param("version", Kind.INT),
            Param("session", Kind.INT, "number of this connection"),
            Param("scope", Kind.STR, "what this client may do"),
            Param("message_bytes_max", Kind.INT, "of a request", "bytes"),
            Param("pending_requests_max", Kind.INT, "requests that may wait"),
            Param("subscriptions_max", Kind.INT, "subscriptions at a time"),
            Param("rate_hz_max", Kind.FLOAT, "updates of one subscription", "1/s"),
        ),
    ),
    _method(
        "api.methods",
        "List all methods with their parameters, results and scopes.",
        (),
        (Param("version", Kind.INT, "of this interface"), Param("methods", Kind.LIST, "sorted by name")),
    ),
    _method("api.ping", "Answer, and do nothing else."),
    _method(
        "api.cancel",
        "Cancel one of this client's requests that has no answer yet; it is answered with an error then.",
        (Param("id", Kind.INT, "of the request"),),
        (Param("found", Kind.BOOL, "whether there was one"),),
    ),
    _method("state.get", "Return the fields' values, once.", (_FIELDS,), (_SEQUENCE, _VALUES)),
    _method(
        "api.watch",
        "Return the fields' values, and send what changes from then on.",
        (
            _FIELDS,
            Param(
                "rate_hz",
                Kind.FLOAT,
                "at most so often",
                "1/s",
                required=False,
                default=10.0,
                low=RATE_HZ_MIN,
                high=RATE_HZ_MAX,
            ),
        ),
        (Param("subscription", Kind.INT, "its number in updates"), _SEQUENCE, _VALUES),
    ),
    _method("api.unwatch", "End a subscription.", (Param("subscription", Kind.INT, "its number"),)),
    _method(
        "api.listen",
        "Say which notifications to send from now on; none until this is called.",
        (Param("events", Kind.LIST, "globs of their names; * stands for any characters"),),
    ),
)
