"""Methods of the interface that let browsers into the live page, and put them out."""

from typing import Any

from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Registry, Scope
from coordinator.support.values import Value
from coordinator.web.access import LINK_S
from coordinator.web.server import WebServer


def add_page_methods(registry: Registry, page: "WebServer") -> None:
    """Add the methods of PAGE to REGISTRY."""

    def link(_caller: Caller, params: dict[str, Any]) -> Value:
        return {"url": page.new_link(Scope[params["scope"].upper()]), "expires_s": LINK_S}

    async def sign_out(_caller: Caller, _params: dict[str, Any]) -> Value:
        return {"sessions": await page.sign_all_out()}

    scopes = (Scope.WATCH.word, Scope.OPERATE.word)
    registry.add(
        Method(
            "page.link",
            Scope.ADMIN,
            "Return an address that lets one browser into the live page, once.",
            link,
            (
                Param(
                    "scope",
                    Kind.STR,
                    "what the browser may do",
                    required=False,
                    default=Scope.OPERATE.word,
                    choices=scopes,
                ),
            ),
            (
                Param("url", Kind.STR, "to be opened in the browser"),
                Param("expires_s", Kind.FLOAT, "for so long it can be used", "s"),
            ),
        )
    )
    registry.add(
        Method(
            "page.sign_out",
            Scope.ADMIN,
            "End the sessions of all browsers, and make links that were not used yet useless.",
            sign_out,
            (),
            (Param("sessions", Kind.INT, "that there were"),),
        )
    )
