"""Motion of the proxy: contact detection, constraints, moving objects, rolling and rest position; used by `step`.

The friction laws are in `friction`.
"""
