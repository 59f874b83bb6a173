"""User without an entry in passwd and without HOME, as under cron or in a container."""

from typing import Final

import pytest

NAMES: Final = (
    *("HOME", "USER", "LOGNAME", "LNAME", "USERNAME", "SUDO_USER"),
    *("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "SOFTFINGER_BLACKBOX_DIR"),
)


def forget_user(patch: pytest.MonkeyPatch) -> None:
    """Remove all information about the user from this process and from the environment of its children."""
    for name in NAMES:
        patch.delenv(name, raising=False)
    patch.setattr("pwd.getpwuid", lambda uid: {}[uid])
