"""README and docs against the code: tables are parsed, examples run."""

import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import paper_mapping
from helpers.programs import Program
from helpers.telemetry_records import put, synthetic
from helpers.waits import repeated

from softfinger import run_recording
from softfinger.config import errors
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES, MODE_NAMES
from softfinger.proxy.step_result import STEP_FIELDS
from softfinger.server import signals
from softfinger.server.cli import VERBS, main, make_parser
from softfinger.server.wire import client, protocol
from softfinger.server.wire.publisher import Publisher

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
RUNNING = (ROOT / "docs" / "operate" / "running.md").read_text()
HOW = (ROOT / "docs" / "how-it-works.md").read_text()
CONVENTIONS = (ROOT / "docs" / "model" / "conventions.md").read_text()


def table(text: str, heading: str) -> list[list[str]]:
    """Rows of the first table below a heading, without its head."""
    part = text.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return rows[2:]


def test_exit_codes_are_those_of_the_errors():
    listed = {int(row[0]) for row in table(RUNNING, "Exit codes") if row[0] != "128 + n"}
    assert signals.compute_exit_code(15) == 128 + 15
    tree = [errors.HapticError, protocol.ProtocolError, client.NoTelemetry]
    for kind in tree:
        tree.extend(kind.__subclasses__())
    assert listed == {0} | {kind.exit_code for kind in tree}


def commands(text: str) -> list[list[str]]:
    """Return the arguments of each `softfinger ...` line, without comments and redirections."""
    rows = re.findall(r"^    .*$", text, re.MULTILINE)
    for _, body in re.findall(r"^( *)```(?:sh|console)\n(.*?)^\1```", text, re.MULTILINE | re.DOTALL):
        rows += body.splitlines()
    lines = [line[1] for line in (re.match(r" *(softfinger .*?)(?: [|>&].*)?$", row) for row in rows) if line]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def test_every_command_in_readme_and_docs_is_one():
    parser, count = make_parser(), 0
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for words in commands(page.read_text()):
            parser.parse_args(words)
            count += 1
    assert count > 30
    assert set(re.findall(r"softfinger (?!import\b)([a-z]+)\b", README + RUNNING + HOW)) - {"VERB"} <= set(VERBS)


@pytest.mark.real_time
def test_commands_of_the_readme_run(tmp_path, endpoints, monkeypatch, capsys):
    ran = []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my-scene.toml").write_text(re.search(r"```toml\n(.*?)```", README, re.DOTALL)[1])
    for words in commands(README):
        own = [f"ipc://{tmp_path}/{name}" for name in ("t", "c")]
        more = {
            "monitor": ["--endpoint", endpoints[0], "--once"],
            "view": ["--endpoint", endpoints[0], "--commands", endpoints[1], "--no-open", "--duration", "0.2"],
            "ctl": ["--endpoint", endpoints[1]],
            "run": ["--duration", "0.2", "--realtime", "off", "--endpoint", own[0], "--commands", own[1]],
            "doctor": None,  # a look at this machine, which may be bad: tests/tools/test_doctor.py
        }.get(words[0], [])
        if more is None or "omega-6" in words:  # a device that is not here
            continue
        replaced = [word.replace("=sphere", "=frictionless-plane") for word in words]  # compiled for other tests, too
        assert main([*replaced, *more]) == 0, words
        ran.append(words[0])
    assert main(["ctl", "set_scene", "scene=paper-plane", "--endpoint", endpoints[1]]) == 0  # as it was
    assert {"monitor", "ctl", "check", "replay", "run", "scenes", "devices"} <= set(ran)


def test_the_readme_is_two_screens():
    assert len(README.splitlines()) <= 100


@pytest.mark.real_time
def test_python_of_the_front_door_runs(tmp_path, endpoints, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "python.md").read_text()
    assert "with Client() as" in page
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    names: dict[str, object] = {}
    exec(compile(code.replace("Client()", f"Client(*{endpoints!r})"), "python.md", "exec"), names)
    assert names["touch"].force[2] == pytest.approx(0.5, rel=1e-12)  # 1000 N/m, 0.5 mm; rounding of a few operations
    assert len(names["newest"]) > 0


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page: its headings, as the site and code hosts write them."""
    text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", line) for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def test_the_reference_names_every_attribute_of_a_step():
    rows = re.findall(r"^\| (`.*?`) \| ", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(STEP_FIELDS)


def test_every_link_in_readme_and_docs_has_a_target():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md")]:
        for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]*))?\)", page.read_text()):
            file = page.parent / target if target else page
            assert file.exists(), f"{page.name} links to {target}"
            assert not anchor or anchor in anchors(file), f"{page.name} links to {target}#{anchor}"


def test_the_site_has_every_page_once():
    _, navigation = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")
    named = re.findall(r"([\w./-]+\.md)$", navigation, re.MULTILINE)
    pages = [str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")]
    assert sorted(named) == sorted(pages)


def test_lists_are_lists_on_the_site_too():
    """Python's Markdown needs an empty line before a list, although code hosts do not."""
    for page in (ROOT / "docs").rglob("*.md"):
        text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        lines = ["", *text.splitlines()]
        for before, line in pairwise(lines):
            if re.match(r"(- |\d+\. )", line):
                assert re.match(r"$|- |\d+\. | ", before), f"{page.name}: {line}"


@pytest.mark.plain
def test_the_worked_walk_is_true(tmp_path):
    rows = table(HOW, "The worked walk")
    assert 10 <= len(rows) <= 15
    for _, link, _ in rows:
        name, target = re.fullmatch(r"\[`(\w+)`\]\(\.\./([\w/.]+)\)", link).groups()
        assert re.search(rf"^def {name}\(", (ROOT / target).read_text(), re.MULTILINE), f"no {name} in {target}"
    stages = re.findall(r"`(\w+)`", HOW.partition("Row 9 has these stages")[2].partition("\n## ")[0])
    contact = "".join(path.read_text() for path in (ROOT / "proxy" / "kernels" / "contact").rglob("*.py"))
    assert len(stages) > 5
    for name in stages:
        assert re.search(rf"^def {name}\(", contact, re.MULTILINE), f"no {name} in proxy/kernels/contact"
    still = np.column_stack([np.arange(600) * 1e-3, np.tile([0.0, 0.0, 0.0095, 1.0, 0.0, 0.0, 0.0], (600, 1))])
    np.savetxt(tmp_path / "still.csv", still, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    records = run_recording(tmp_path / "still.csv", "paper-plane")
    # Rounding of a few operations.
    assert records["force"][[0, -1], 2] == pytest.approx([0.001, 0.5], rel=1e-9)
    assert records["contact.normal_force"][0] == pytest.approx(0.5, rel=1e-9)


@pytest.mark.real_time
def test_python_of_the_readme_runs():
    first, code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(first, names := {})
    assert names["touch"].cause == "touch"
    records = synthetic(400)
    put(records, "contact.mode", 2)
    with Publisher("tcp://127.0.0.1:*") as publisher:
        code = code.replace("tcp://127.0.0.1:5555", publisher.endpoint)
        assert len(code.strip().splitlines()) == 5  # as the README promises
        words = [sys.executable, "-u", "-c", code]
        with (
            repeated(lambda: publisher.publish(records)),
            Program(words, stdout=subprocess.PIPE, text=True, kill_at_end=True) as process,
        ):
            line = process.stdout.readline()
    assert "sliding" in line and "lost:" in line


def numbers(cell: str) -> list[float]:
    return [float(part) for part in cell.split(",")]


@pytest.mark.plain
@pytest.mark.parametrize("row", table(CONVENTIONS, "Checked examples"), ids=lambda row: row[0])
def test_signs_are_as_documented(row):
    motion, force, torque = row
    engine = Engine(build(Scene, paper_mapping(), "conventions"))
    amount = float(match[1]) if (match := re.search(r"([\d.]+) (?:mm|rad)", motion)) else 0.0
    axis = {"x": 0, "z": 2}[match[1]] if (match := re.search(r"\+([xz])", motion)) else 2
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
    part = CONVENTIONS.split("## Contact modes and their causes\n", 1)[1]
    modes, causes = re.findall(r"(?:^\|.*\n)+", part, re.MULTILINE)
    assert re.findall(r"^\| (\w+) \| (\d)", modes, re.MULTILINE) == [(n, str(i)) for i, n in enumerate(MODE_NAMES)]
    assert re.findall(r"^\| (\w+) \| [\d]", causes, re.MULTILINE) == [name for name in CAUSE_NAMES if name != "none"]
