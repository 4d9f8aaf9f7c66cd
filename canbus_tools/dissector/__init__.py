"""The Wireshark dissector, made from the protocol's one description."""
