"""The reference pages of docs/ equal those generated from the program's tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from softfinger.tools.pages import reference

pytestmark = pytest.mark.plain

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"


@pytest.mark.parametrize("name", reference.PAGES)
def test_a_page_equals_the_generated_one(name: str) -> None:
    """The texts are equal, so a changed key, default or docstring changes the page."""
    assert (FOLDER / name).read_text("utf-8") == reference.PAGES[name](), "run `make reference`"


def test_the_folder_has_only_these_pages(tmp_path: Path) -> None:
    assert reference.main([str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in FOLDER.iterdir()}
