"""``make thorough``: everything that takes too long for ``make test``, one after the other, and one table."""
