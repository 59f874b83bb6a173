"""Devices computed from their published facts, without a look at the drivers they are to prove."""
