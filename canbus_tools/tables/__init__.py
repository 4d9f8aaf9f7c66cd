"""Tables sent to drives and nodes without a coordinator."""
