"""Readers of mesh files: one module per format, each with `read(data) -> Faces`; they raise ValueError with the fault.

Opens no files and imports no library but numpy: `proxy.meshes.reading` calls the readers and checks their results.
"""
