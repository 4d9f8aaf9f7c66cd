"""Counts the values of a line of JSON without making them: a list costs two bytes to send, and 50 to hold."""


def has_more_items(body: bytes, most: int) -> bool:
    """Tell whether the lists and maps of BODY have more than MOST items in all; it never does so wrongly.

    Says no as well to some that have up to twice as many. Of what is no JSON any answer is right.
    """
    if len(body) <= most or not _has_more(body, most):
        return False
    bare = body.replace(rb"\\", b"").replace(rb"\"", b"")  # a quote now begins or ends a string
    if bare.count(b'"') > 4 * most:  # each string is a key or an item
        return True
    return _has_more(b"".join(bare.split(b'"')[::2]), most)


def _has_more(body: bytes, most: int) -> bool:
    """Tell whether BODY has too many commas between items, or too many lists and maps."""
    return body.count(b",") >= most or body.count(b"[") + body.count(b"{") > most + 1
