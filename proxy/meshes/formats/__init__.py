"""Readers of mesh files: one module per format, each with `read(data) -> Faces`; they raise ValueError in words.

Opens no files and imports no library but numpy: `proxy.meshes.reading` calls the readers and checks what they return.
"""
