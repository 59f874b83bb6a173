"""Names that users' files, scripts and programs depend on still exist."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from references import contract

pytestmark = pytest.mark.plain
LISTED = json.loads((Path(contract.__file__).with_suffix(".json")).read_text("utf-8"))
NAMES = contract.names()


@pytest.mark.parametrize("kind", LISTED)
def test_no_name_disappears(kind: str) -> None:
    assert set(LISTED[kind]) - set(NAMES[kind]) == set()
