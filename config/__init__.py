"""Configuration: what a scene and a rig may say, read from TOML and checked before anything moves.

Nothing of how it is computed; every other package may import this one, and it imports none of them.
"""
