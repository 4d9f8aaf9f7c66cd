"""MT: a table that one transmission brings to several axles at once (firmware/objects/mt.h)."""
