"""A node's data dictionary: parsing, cache, identification, messages to and from bytes."""
