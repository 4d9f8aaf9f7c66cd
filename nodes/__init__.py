"""One node as the host sees it: transports, link, dictionary, id assignment, clock; and virtual nodes."""
