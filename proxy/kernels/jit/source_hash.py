"""Identity of this version of the program, for caches of more than kernels. Reading every source file takes 10 ms."""

from __future__ import annotations

from typing import Final

from softfinger.proxy.kernels.jit.cache import hash_of_sources

SOURCE_HASH: Final = hash_of_sources(("config", "drivers", "proxy", "server", "tools"))
"""Hash over every source file as it was at import."""
