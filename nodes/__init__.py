"""The host's side of one node: transports, link, dictionary, id assignment, clock; and virtual nodes."""
