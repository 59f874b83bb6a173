"""Meshes: from their files, through what is mended of them, to what the kernels take. No contact."""
