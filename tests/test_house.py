"""Rules of the repository: docstrings of packages, maps that match the code, planted mistakes, names of users."""

import ast
import importlib
import importlib.util
import re
import tomllib
from pathlib import Path

import mutants
import pytest
from references import contract

pytestmark = pytest.mark.plain
ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("config", "drivers", "proxy", "server", "tools")
FOLDERS = sorted({path.parent for package in PACKAGES for path in (ROOT / package).rglob("*.py")})


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_every_package_documents_its_content_and_exclusions(folder: Path) -> None:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
    inside, _, outside = text.partition("\n\n")
    assert len(inside.split()) >= 5 and len(outside.split()) >= 4, f"{name(folder)}: {text!r}"


def test_tests_that_need_more_packages_import_names_that_exist() -> None:
    """They are skipped without these packages, so a renamed function would not be noticed."""
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text("utf-8")
        if "importorskip(" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("softfinger."):
                module = importlib.import_module(node.module or "")
                for alias in node.names:
                    if hasattr(module, "__path__") and importlib.util.find_spec(f"{node.module}.{alias.name}"):
                        continue
                    assert hasattr(module, alias.name), f"{name(path)}:{node.lineno}: {node.module} has no {alias.name}"


def test_no_failing_test_waits_for_its_program() -> None:
    """The block of a Popen ends with its program, which may run for ever: tests have helpers.programs.Program."""
    lines = [
        f"{name(path)}:{node.context_expr.lineno}"
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if "subprocess.Popen(" in (text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.withitem) and ast.unparse(node.context_expr).startswith("subprocess.Popen(")
    ]
    assert lines == []


def test_the_map_is_true() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    named = re.findall(r"`((?:config|docs|examples|drivers|proxy|server|tests|tools)/[\w/.-]*)`", page)
    assert len(named) > 30 and not [place for place in named if not (ROOT / place).exists()]


def test_each_reason_for_less_coverage_is_of_a_file() -> None:
    table = tomllib.loads((ROOT / "tests" / "coverage_reasons.toml").read_text("utf-8"))["reason"]
    files = [file for entry in table for file in entry["files"]]
    assert len(set(files)) == len(files) and not [file for file in files if not (ROOT / file).is_file()]


def test_each_planted_mistake_can_be_made() -> None:
    for mutant in mutants.read():
        text = (ROOT / mutant.file).read_text("utf-8")
        assert text.count(mutant.old) == 1 and mutant.tests, mutant
        compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
        for test in mutant.tests:
            file, _, function = test.partition("[")[0].partition("::")
            assert f"def {function.rpartition('::')[2]}" in (ROOT / file).read_text("utf-8"), test


def test_marks_of_helpers_are_named_in_the_files_that_use_them() -> None:
    """Collection skips files without the name of the selected mark in their text (tests/conftest.py)."""
    tests = {path: path.read_text("utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    for helper in (ROOT / "tests" / "helpers").glob("*.py"):
        marks = set(re.findall(r"pytest\.mark\.(plain|real_time|system)\b", helper.read_text("utf-8")))
        users = {path: text for path, text in tests.items() if f"helpers.{helper.stem} import" in text}
        assert [name(path) for path, text in users.items() if any(mark not in text for mark in marks)] == []


def test_the_index_lists_every_page() -> None:
    index = ROOT / "docs" / "index.md"
    linked = {(index.parent / target).resolve() for target in re.findall(r"\]\(([^)#:]+)\)", index.read_text("utf-8"))}
    pages = {path.resolve() for path in (ROOT / "docs").rglob("*.md")} - {index.resolve()}
    assert not {name(page) for page in pages - linked}


def test_names_in_the_glossary_exist() -> None:
    rows = re.findall(r"^\| .* \| .* \| `([^`]+)`", (ROOT / "docs" / "glossary.md").read_text("utf-8"), re.MULTILINE)
    sources = "\n".join(path.read_text("utf-8") for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    for place in rows:
        if "/" in place:
            places = (ROOT / place, ROOT / "proxy" / "kernels" / place)
            assert any(path.exists() for path in places), place
        elif not place.startswith("["):
            assert re.search(rf"\b{place.rpartition('.')[2]}\b", sources), place


def test_no_name_that_users_depend_on_disappears() -> None:
    names = contract.names()
    for kind, tables in tomllib.loads((ROOT / "tests" / "references" / "contract.toml").read_text("utf-8")).items():
        listed = {first + ending for first, endings in tables.items() for ending in endings}
        assert listed - set(names[kind]) == set()
