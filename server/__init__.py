"""Command line, daemon and servo loop.

Contains no physics and no device protocol: these are in `proxy` and `drivers`. Imports nothing from `tools`.
"""
