"""Readers of mesh files: one module per format, each with `read(data) -> Faces`. They raise ValueError in words."""
