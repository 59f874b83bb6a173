"""Configuration: schema of scenes, rigs and faults, read from TOML and validated before the device moves.

Contains no contact computation. Every other package may import this one; it imports none of them.
"""
