"""README and docs against the code: tables are parsed, examples run."""

import re
import subprocess
import sys
import threading
import tomllib
from pathlib import Path

import numpy as np
import pytest
from conftest import paper_mapping
from telemetry_records import put, synthetic

from softfinger.config import errors
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.state import CAUSE_NAMES, MODE_NAMES
from softfinger.server import client, protocol
from softfinger.server.cli import VERBS
from softfinger.server.telemetry import Publisher

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
CONVENTIONS = (ROOT / "docs" / "conventions.md").read_text()


def table(text: str, heading: str) -> list[list[str]]:
    """Rows of the first table below a heading, without its head."""
    part = text.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return rows[2:]


def test_exit_codes_are_those_of_the_errors():
    """README lists exactly the exit codes the program can return."""
    listed = {int(row[0]) for row in table(README, "Exit codes")}
    tree = [errors.HapticError, protocol.ProtocolError, client.NoTelemetry]
    for kind in tree:
        tree.extend(kind.__subclasses__())
    assert listed == {0} | {kind.exit_code for kind in tree}


def test_every_verb_named_in_the_readme_exists():
    """Each `softfinger VERB` in the README is a verb."""
    assert set(re.findall(r"softfinger ([a-z]+)\b", README)) - {"VERB"} <= set(VERBS)


def test_every_link_in_readme_and_docs_leads_somewhere():
    """Relative links point at files that are there."""
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_files_named_in_the_readme_exist():
    """The table that says where to find things is true."""
    for _, place in table(README, "Find your way"):
        folder, *files = re.findall(r"`([^`]+)`", place)
        for name in files or [""]:
            path = ROOT / folder / name if files and folder.endswith("/") else ROOT / folder
            assert path.exists() or (ROOT / name).exists(), path


def test_scene_in_the_readme_is_valid():
    """The scene shown can be loaded as it stands."""
    text = re.search(r"```toml\n(.*?)```", README, re.DOTALL)[1]
    assert build(Scene, tomllib.loads(text), "README").object[0].name == "table"


def test_subscriber_in_the_readme_runs():
    """The five lines of Python print the sliding samples of a real publisher."""
    code = re.search(r"```python\n(.*?)```", README, re.DOTALL)[1]
    records = synthetic(400)
    put(records, "contact.mode", 2)
    with Publisher("tcp://127.0.0.1:*") as publisher:
        code = code.replace("tcp://127.0.0.1:5555", publisher.endpoint)
        assert len(code.strip().splitlines()) == 5  # as the README promises
        stop = threading.Event()

        def publish() -> None:
            while not stop.wait(0.02):
                publisher.publish(records)

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            process = subprocess.Popen([sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, text=True)
            line = process.stdout.readline()
        finally:
            process.kill()
            process.communicate()
            stop.set()
            thread.join()
    assert "sliding" in line and "lost:" in line


def numbers(cell: str) -> list[float]:
    return [float(part) for part in cell.split(",")]


@pytest.mark.parametrize("row", table(CONVENTIONS, "Checked examples"), ids=lambda row: row[0])
def test_signs_are_as_documented(row):
    """Each documented motion gives the documented force and torque."""
    motion, force, torque = row
    engine = Engine(build(Scene, paper_mapping(), "conventions"))
    amount = float(found[1]) if (found := re.search(r"([\d.]+) (?:mm|rad)", motion)) else 0.0
    axis = {"x": 0, "z": 2}[found[1]] if (found := re.search(r"\+([xz])", motion)) else 2
    for share in np.linspace(0.0, 1.0, 101):
        position, orientation = np.array([0.0, 0.0, 0.009]), np.array([1.0, 0.0, 0.0, 0.0])
        if motion.startswith("drag"):
            position[axis] += share * amount * 1e-3
        elif motion.startswith(("spin", "roll")):
            orientation[0], orientation[1 + axis] = np.cos(share * amount / 2), np.sin(share * amount / 2)
        step = engine.step(position, orientation)
    # Rounding of 100 steps of small rotations, far below the digits shown.
    np.testing.assert_allclose(step.force, numbers(force), atol=1e-12)
    np.testing.assert_allclose(step.torque, numbers(torque), atol=1e-14)


def test_modes_and_causes_are_as_documented():
    """The tables of modes and causes list what the code has, in its order."""
    part = CONVENTIONS.split("## Contact modes and their causes\n", 1)[1]
    modes, causes = re.findall(r"(?:^\|.*\n)+", part, re.MULTILINE)
    assert re.findall(r"^\| (\w+) \| (\d)", modes, re.MULTILINE) == [(n, str(i)) for i, n in enumerate(MODE_NAMES)]
    assert re.findall(r"^\| (\w+) \| [\d]", causes, re.MULTILINE) == [name for name in CAUSE_NAMES if name != "none"]
