"""Devices emulated from published facts, independent of the drivers they test."""
