"""Configuration of the virtual machine, tested without starting one."""

import ast
import importlib
import os
from pathlib import Path

import pytest
from helpers.programs import run_program
from vm import run

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = sorted((ROOT / "tests" / "vm").glob("*.py"))


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.name)
def test_imports_of_vm_programs_exist(program: Path) -> None:
    for node in ast.walk(ast.parse(program.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("softfinger"):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")


def test_pytest_accepts_its_command() -> None:
    guest = {key: value for key, value in run.guest_environment().items() if key.startswith("PYTEST_")}
    assert guest
    command = run.tests(["--collect-only", "-q", str(Path(__file__).relative_to(ROOT))], systemd=False)
    run_program(command, cwd=ROOT, env=os.environ | guest, check=True)


FORK = """
import faulthandler, os, signal

def test_a_fork_starts_a_timer():
    pid = os.fork()
    if pid == 0:
        signal.alarm(20)  # ends it, even in C code
        faulthandler.dump_traceback_later(60)
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
"""


def test_a_fork_of_its_tests_starts_pytests_timer(tmp_path: Path) -> None:
    file = tmp_path / "test_fork.py"
    file.write_text(FORK)
    command = run.tests([f"--config-file={ROOT / 'pyproject.toml'}", str(file)], systemd=False)
    run_program(command, cwd=ROOT, check=True)


@pytest.mark.parametrize(
    "words", [[], ["-k", "unplugged"], ["tests/vm/under_systemd.py"], ["tests/vm/on_hid.py::TestV2"]]
)
def test_every_vm_test_runs_on_its_machine(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    named = [word for word in words if word.startswith("tests/")]
    for systemd in (False, True):
        modules = [word for word in run.tests(words, systemd) if word.startswith("tests/")]
        assert all(("systemd" in module) == systemd for module in modules)
        wanted = [module for module in named if ("systemd" in module) == systemd]
        assert modules == wanted if named else modules
