"""Opening of a browser at the page's secret address.

The address is passed in a file, because all users of a machine can read the arguments of a program.
"""

from __future__ import annotations

import html
import logging
import os
import secrets
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.config.schema import find_runtime_folder
from softfinger.server.wire.endpoint import make_runtime_folder

log: Final = logging.getLogger(__name__)

REDIRECT_HTML: Final = """<!doctype html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={address}">
<title>softfinger</title>
<a href="{address}">the page</a>
"""


@contextmanager
def open_browser(address: str) -> Iterator[None]:
    """Open a browser at a secret address by a file that exists during the block, so that the browser can reload it.

    The file is in this user's runtime folder, mode 600, and redirects to the address.
    """
    try:
        make_runtime_folder()
        path = find_runtime_folder() / f"page-{secrets.token_hex(8)}.html"
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except (ConfigError, OSError) as error:
        log.warning("no browser was opened: %s; open the address of the page", error)
        yield
        return
    try:
        with os.fdopen(file, "w") as out:
            out.write(REDIRECT_HTML.format(address=html.escape(address, quote=True)))
        webbrowser.open(path.as_uri())
        yield
    finally:
        path.unlink(missing_ok=True)
