"""Parameters of a call, checked: what is missing or of another type is the client's error; no I/O."""

from collections.abc import Mapping
from typing import Any, Final

from coordinator.klippy_api.wire import Request
from nodes.support.errors import CanductorError

TEMPLATE_ITEMS_MAX: Final = 32
OBJECTS_MAX: Final = 1024
"""In one query or subscription."""
FIELDS_MAX: Final = 2_048
"""Likewise, of all objects together: twice what a large machine has."""

RequestedFields = Mapping[str, list[str] | None]
"""By object: its fields; None: all."""


class RequestError(CanductorError):
    """A call that fails; the text is for people, and may have several lines."""


def text_param(request: Request, name: str) -> str:
    """Return the text NAME; raises RequestError."""
    found = _given(request, name)
    if not isinstance(found, str):
        raise RequestError(f"{request.method}: the argument '{name}' must be a text")
    return found


def template_param(request: Request) -> Mapping[str, Any]:
    """Return ``response_template``, which the messages to come are made from; raises RequestError."""
    found = _given(request, "response_template", {})
    if not isinstance(found, dict) or len(found) > TEMPLATE_ITEMS_MAX:
        raise RequestError(f"{request.method}: the argument 'response_template' must be a small object")
    return found


def objects_param(request: Request) -> RequestedFields:
    """Return ``objects``: names with null or a list of fields; raises RequestError."""
    found = _given(request, "objects")
    if not isinstance(found, dict) or len(found) > OBJECTS_MAX:
        raise RequestError(
            f"{request.method}: the argument 'objects' must be an object of at most {OBJECTS_MAX}"
        )
    for name, fields in found.items():
        if fields is None:
            continue
        if not isinstance(fields, list) or not all(isinstance(field, str) for field in fields):
            raise RequestError(
                f"{request.method}: the fields of '{name[:80]}' must be null or a list of texts"
            )
    if sum(len(fields) for fields in found.values() if fields is not None) > FIELDS_MAX:
        raise RequestError(f"{request.method}: the argument 'objects' has more than {FIELDS_MAX:,} fields")
    return found


def _given(request: Request, name: str, default: Any = None) -> Any:
    found = request.params.get(name, default)
    if found is None:
        raise RequestError(f"{request.method}: the argument '{name}' is missing")
    return found
