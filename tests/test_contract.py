"""Names that users' files, scripts and programs depend on still exist."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from references import contract

pytestmark = pytest.mark.plain
LISTED = tomllib.loads(Path(contract.__file__).with_suffix(".toml").read_text("utf-8"))
NAMES = contract.names()


@pytest.mark.parametrize("kind", LISTED)
def test_no_name_disappears(kind: str) -> None:
    listed = {first + ending for first, endings in LISTED[kind].items() for ending in endings}
    assert listed - set(NAMES[kind]) == set()
