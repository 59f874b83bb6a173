"""Configuration: what a scene and a rig may say, read from TOML and checked before anything moves."""
