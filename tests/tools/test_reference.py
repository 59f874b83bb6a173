"""Pages of docs/ with generated content: the reference pages, and the tables of the study."""

from pathlib import Path

import pytest

from softfinger.config.errors import ConfigError
from softfinger.tools import study
from softfinger.tools.accuracy.report import format_table
from softfinger.tools.pages import reference

pytestmark = pytest.mark.plain

DOCS = Path(__file__).resolve().parents[2] / "docs"
FOLDER = DOCS / "reference"
PAGE = "before\n<!-- study: drift -->\n| old |\n<!-- end -->\nafter <!-- study: orders -->\n<!-- end -->\n"


@pytest.mark.parametrize("name", reference.PAGES)
def test_a_page_equals_the_generated_one(name: str) -> None:
    """The texts are equal, so a changed key, default or docstring changes the page."""
    assert (FOLDER / name).read_text("utf-8") == reference.PAGES[name](), "run `make reference`"


def test_the_folder_has_only_these_pages(tmp_path: Path) -> None:
    assert reference.main([str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in FOLDER.iterdir()}


def test_only_marked_tables_are_replaced():
    page = study.insert(PAGE, {"drift": "| new |\n", "orders": "| 2 |\n"})
    assert page.startswith("before\n<!-- study: drift -->\n\n| new |\n\n<!-- end -->\nafter ")
    assert study.insert(page, {"drift": "| new |\n", "orders": "| 2 |\n"}) == page


def test_table_becomes_markdown():
    made = format_table("title", ("surface", "over_euler"), [("plane", "1"), ("torus", "2")], 1)
    assert study.format_markdown(made) == "| surface | over_euler |\n| --- | --- |\n| plane | 1 |\n| torus | 2 |\n"


def test_a_folder_without_pages_is_refused(tmp_path, capsys):
    assert study.main([str(tmp_path)]) == ConfigError.exit_code
    assert "contains no pages" in capsys.readouterr().err


def test_a_mark_without_a_table_is_an_error():
    with pytest.raises(ConfigError, match="study: orders -->: no such table; there are drift"):
        study.insert(PAGE, {"drift": "| new |"})


def test_every_table_has_its_place_in_the_pages():
    marked = [match["name"] for page in DOCS.rglob("*.md") for match in study.BLOCK.finditer(page.read_text())]
    assert sorted(marked) == sorted(study.TABLES)
