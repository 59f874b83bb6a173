"""Files that a public host reads: workflows, forms, citation, compose file."""

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from softfinger.config.load import load_rig
from softfinger.server.cli import make_parser
from softfinger.server.install.texts import RTPRIO
from softfinger.server.verbs.options import RIG

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.name != "config.yml")
DOCKER = (ROOT / "docs" / "operate" / "docker.md").read_text()


class OnceLoader(yaml.SafeLoader):
    """Refuse duplicate keys of a mapping, of which YAML's own loader takes the last."""


def _mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    keys = [key.value for key, _ in node.value]
    assert len(keys) == len(set(keys)), f"{node.start_mark}: a key stands twice"
    loader.flatten_mapping(node)
    return loader.construct_mapping(node, deep=True)


OnceLoader.add_constructor("tag:yaml.org,2002:map", _mapping)


def read(path: Path) -> Any:
    return yaml.load(path.read_text(), OnceLoader)


def steps(workflow: dict[Any, Any]) -> list[dict[str, Any]]:
    return [step for job in workflow["jobs"].values() for step in job.get("steps", [])]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_has_minimal_permissions(path: Path) -> None:
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert "uses" in job or job["timeout-minutes"] <= 120
    used = [step["uses"] for step in steps(workflow) if "uses" in step]
    assert used and all(re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v\d+)", action) for action in used), used


def test_ci_runs_supported_pythons_and_existing_targets() -> None:
    workflow = read(ROOT / ".github" / "workflows" / "ci.yml")
    pythons = [text.rpartition(" ")[2] for text in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", text)]
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == pythons
    run = "\n".join(step.get("run", "") for step in steps(workflow))
    called = set(re.findall(r"make ([a-z-]+)", run))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"lint", "docs", "test", "test-system", "wheel"} <= called <= targets
    assert run.index("make test ") < run.index("make emulators") < run.index("make test-system")
    own = re.sub(r"^#.*", "", (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)
    assert re.findall(r"\bmake ([a-z-]+)", own) == ["lint", "docs", "test", "emulators", "browser", "test-system"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_a_release_is_tested_attested_and_of_its_tag() -> None:
    path = ROOT / ".github" / "workflows" / "release.yml"
    jobs = read(path)["jobs"]
    assert jobs["ci"]["uses"] == "./.github/workflows/ci.yml"
    assert jobs["nightly"]["uses"] == "./.github/workflows/nightly.yml"
    assert jobs["attest"]["needs"] == ["ci", "nightly"] and jobs["publish"]["needs"] == "attest"
    assert {"attestations": "write", "id-token": "write"}.items() <= jobs["attest"]["permissions"].items()
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert "secrets." not in path.read_text()


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
def test_forms_use_existing_commands(path: Path) -> None:
    form = read(path)
    assert form["name"] and form["description"]
    ids = [part["id"] for part in form["body"]]
    assert len(ids) == len(set(ids))
    for part in form["body"]:
        assert part["type"] in ("input", "textarea", "dropdown", "checkboxes") and part["attributes"]["label"]
    parser, commands = make_parser(), re.findall(r"`softfinger ([^`]+)`", path.read_text())
    assert commands
    for words in commands:
        if words != "--version":
            parser.parse_args(words.replace("RIG", "falcon").split())


def test_the_citation_is_of_this_version() -> None:
    cited = read(ROOT / "CITATION.cff")
    assert (cited["cff-version"], cited["version"]) == ("1.2.0", PROJECT["version"])
    assert cited["license"] == PROJECT["license"] and cited["repository-code"] == PROJECT["urls"]["Homepage"]
    assert cited["message"] and cited["title"] and cited["authors"] and cited["preferred-citation"]["year"] == 2013


def test_compose_has_the_flags_of_the_docs() -> None:
    composed = read(ROOT / "compose.yaml")
    replay, device = composed["services"]["replay"], composed["services"]["device"]
    for service in (replay, device):
        assert service["network_mode"] == "host" and "--network host" in DOCKER
        assert service["restart"] == "no" and service["cap_drop"] == ["ALL"]
        assert {volume.partition(":")[0] for volume in service["volumes"]} & set(composed["volumes"]) == {"kernels"}
    assert device["ulimits"] == {"rtprio": RTPRIO, "memlock": {"soft": -1, "hard": -1}}
    assert f"--ulimit rtprio={RTPRIO}" in DOCKER and "--ulimit memlock=-1" in DOCKER
    assert "/dev/cpu_dma_latency" in device["devices"] and "--device /dev/cpu_dma_latency" in DOCKER
    (rule,) = device["device_cgroup_rules"]
    assert f"--device-cgroup-rule '{rule}'" in DOCKER
    assert "/dev/bus/usb:/dev/bus/usb" in device["volumes"]
    assert not {"devices", "device_cgroup_rules", "ulimits", "group_add"} & set(replay)
    for service in (replay, device):
        args = make_parser().parse_args(service["command"])
        assert load_rig(args.rig or RIG)


def test_files_of_the_host_lead_somewhere() -> None:
    page = (ROOT / "SECURITY.md").read_text()
    for target in re.findall(r"\]\(([^)#:]+)", page):
        assert (ROOT / target).exists(), target
    forms = {path.stem: path.read_text() for path in FORMS}
    assert "softfinger doctor --json" in forms["bug"] and "softfinger doctor --device-report" in forms["device"]
