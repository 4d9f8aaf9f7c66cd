"""What a client sends becomes whole requests, or is refused with its head, before its body is there."""

from http import HTTPStatus

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.web.request_reader import BODY_BYTES_MAX, HEAD_BYTES_MAX, HttpRefusal, RequestReader

GET = b"GET /page.css HTTP/1.1\r\nHost: localhost\r\n\r\n"


def post(*headers: str, body: bytes = b"") -> bytes:
    lines = ["POST /login HTTP/1.1", "Host: localhost", *headers]
    return "\r\n".join([*lines, "", ""]).encode() + body


def with_body(body: bytes) -> bytes:
    return post(f"Content-Length: {len(body)}", body=body)


REQUESTS = st.one_of(st.just(GET), st.binary(max_size=200).map(with_body))


@given(st.lists(REQUESTS, max_size=5), st.data())
def test_requests_come_whole_and_in_order(requests: list[bytes], data: st.DataObject) -> None:
    reader, stream, found, at = RequestReader(), b"\r\n".join(requests), [], 0
    while at < len(stream):
        size = data.draw(st.integers(1, len(stream)))
        reader.waiting += stream[at : at + size]
        at += size
        while (request := reader.next_request()) is not None:
            found.append(request)
    assert found == requests
    assert not reader.waiting


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (post("Transfer-Encoding: chunked"), HTTPStatus.UNSUPPORTED_MEDIA_TYPE),
        (post("transfer-ENCODING : identity", "Content-Length: 2"), HTTPStatus.UNSUPPORTED_MEDIA_TYPE),
        (post("Content-Encoding: gzip", "Content-Length: 2"), HTTPStatus.UNSUPPORTED_MEDIA_TYPE),
        (post(f"Content-Length: {BODY_BYTES_MAX + 1}"), HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
        (post("Content-Length: " + "9" * 5000), HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
        (post("Content-Length: 2", "Content-Length: 3"), HTTPStatus.BAD_REQUEST),
        (post("Content-Length: -1"), HTTPStatus.BAD_REQUEST),
        (post("Content-Length: 0x10"), HTTPStatus.BAD_REQUEST),
        (post("Content-Length:"), HTTPStatus.BAD_REQUEST),
        (GET[:-2] + b"a:b\r\n" * (HEAD_BYTES_MAX // 5), HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE),
        (b"G" * HEAD_BYTES_MAX, HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE),
    ],
)
def test_refused_with_the_head(head: bytes, status: HTTPStatus) -> None:
    reader = RequestReader()
    reader.waiting += head
    refusal = reader.next_request()
    assert isinstance(refusal, HttpRefusal)
    assert refusal.status is status


def test_the_longest_that_are_taken() -> None:
    reader = RequestReader()
    head = GET[:-2] + b"x: " + b"y" * (HEAD_BYTES_MAX - len(GET) - 5) + b"\r\n\r\n"
    for request in (with_body(b"x" * BODY_BYTES_MAX), head):
        reader.waiting += request
        assert reader.next_request() == request
