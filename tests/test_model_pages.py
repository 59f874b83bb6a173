"""The pages of docs/model/: their beginnings, and their worked examples run as printed."""

import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from numba import config

from softfinger.tools.pages import figures

pytestmark = pytest.mark.plain

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted((DOCS / "model").glob("*.md"))
SVG_MAX = 40_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_starts_with_three_sentences_and_a_figure(page: Path) -> None:
    _, sentences, picture, *_ = page.read_text("utf-8").split("\n\n")
    assert len(re.findall(r"[.?!](?=\s|$)", sentences)) == 3, sentences
    match = re.fullmatch(r"!\[[^]]+\]\(\.\./figures/([\w-]+)\.svg\)", picture)
    assert match and match[1] in {f"model-{name}" for name in figures.FIGURES} | {"patches"}
    drawn = (DOCS / "figures" / f"{match[1]}.svg").read_text("utf-8")
    assert len(drawn) < SVG_MAX and "dc:date" not in drawn


@pytest.mark.skipif(not config.DISABLE_JIT, reason="would compile a scene for each page; `make test` runs them")
@pytest.mark.parametrize("page", [path for path in PAGES if path.stem != "conventions"], ids=lambda page: page.stem)
def test_a_worked_example_prints_its_lines(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example = page.read_text("utf-8").split("\n## Worked example\n", 1)[1].split("\n## ", 1)[0]
    (program,) = re.findall(r"```python\n(.*?)```", example, re.DOTALL)
    (printed,) = re.findall(r"```text\n(.*?)```", example, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    with redirect_stdout(StringIO()) as output:
        exec(compile(program, page.name, "exec"), {})
    assert output.getvalue() == printed


@pytest.mark.exhaustive
def test_every_figure_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="an extra")
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}  # else it compiles a scene for each figure
    subprocess.run([sys.executable, "-m", figures.__name__, str(tmp_path)], env=environment, check=True, timeout=600)
    shown = {path.name for path in (DOCS / "figures").glob("model-*.svg")} | {"states.svg", "lift-a-box.svg"}
    assert {path.name for path in tmp_path.iterdir()} == shown
