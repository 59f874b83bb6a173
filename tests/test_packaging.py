"""The distribution: wheel, source archive, pinned versions, and directions of imports."""

import ast
import email
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from helpers.programs import run_program

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("config", "drivers", "proxy", "server", "tools")
OWN_FILE = "softfinger/__init__.py"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSION = PROJECT["project"]["version"]

KERNEL_IMPORTS = ("collections.abc", "llvmlite", "math", "numba", "numpy", "typing", "__future__")
KERNEL_OWN_IMPORTS = ("softfinger.proxy.kernels", "softfinger.proxy.record")


def run(*command: str | Path, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Run to the end with nothing of this environment's import path; fail with the output on a non-zero exit."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    process = run_program([*map(str, command)], cwd=cwd, env=inherited | env)
    assert process.returncode == 0, f"{command}: exit {process.returncode}\n{process.stdout}\n{process.stderr}"
    return process


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the wheel and the source archive, the wheel built from the archive."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (path,) = dist.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the `bin` of a clean environment with the wheel and borrowed dependencies.

    They are borrowed with a .pth file: Python adds its folder to the path, but ignores .pth files in that folder, so
    the editable installation of this checkout is not visible.
    """
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    run(
        *(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel),
        cwd=folder,
    )
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).stdout.strip())
    borrowed = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (site / "borrowed.pth").write_text("\n".join(sorted(borrowed)) + "\n")
    return folder / "bin"


def sources(package: str) -> Iterator[Path]:
    for path in sorted((ROOT / package).rglob("*")):
        if path.is_file() and not {"__pycache__", "node_modules"} & set(path.parts):
            yield path.relative_to(ROOT)


def test_the_wheel_contains_every_source_file_and_nothing_else(wheel: Path) -> None:
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    shipped = {f"softfinger/{path}" for package in PACKAGES for path in sources(package)}
    moved = {"softfinger/config/package.py", "softfinger/config/py.typed", "softfinger/server/main.py"}
    assert names == (shipped - moved) | {OWN_FILE, "softfinger/py.typed", "softfinger/__main__.py"}


@pytest.mark.exhaustive
def test_the_types_of_the_installed_wheel_are_checked(installed: Path, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text('import softfinger\nreveal_type(softfinger.Engine("paper-plane").step)\n')
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    # the others contain none of our modules, or ROS
    folders = (tmp_path / "examples", tmp_path / "examples" / "pytest")
    examples = sorted(str(path) for folder in folders for path in folder.glob("*.py"))
    assert examples
    words = ["--strict", "--config-file=", "--cache-dir=/dev/null", "--python-executable", str(installed / "python")]
    process = run_program([sys.executable, "-m", "mypy", *words, str(program), *examples], cwd=tmp_path)
    assert re.search(r'Revealed type is "def \(position: .*\) -> .*Step"', process.stdout), process.stdout
    assert process.returncode == 0, process.stdout


def test_the_sdist_can_set_up_and_test(dist: Path) -> None:
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers()}
    needed = {
        "Makefile", "constraints.txt", "constraints-docs.txt", "pyproject.toml", "mkdocs.yml", "Dockerfile",
        "compose.yaml", ".ci/run", ".ci/package_page.md", ".github/workflows/ci.yml", "README.md", "LICENSE",
        "CONTRIBUTING.md", "SECURITY.md", "CITATION.cff",
    }  # fmt: skip
    needed |= {str(file) for package in (*PACKAGES, "examples", "tests") for file in sources(package)}
    assert not needed - names and not [name for name in names if name.startswith((".dev", ".venv", ".git/"))]


def test_the_installed_wheel_is_imported(installed: Path, tmp_path: Path) -> None:
    code = "import json, softfinger as f, sys; got = [f.__version__, hasattr(f, 'x'), 'numba' in sys.modules]; "
    code += "import softfinger.server as s; print(json.dumps([got, *f.__path__, s.__file__]))"
    got, *paths = json.loads(run(installed / "python", "-c", code, cwd=tmp_path).stdout)
    assert got == [VERSION, False, False]
    for path in paths:
        assert Path(path).is_relative_to(installed.parent), path
    assert run(installed / "python", "-m", "softfinger", "--version", cwd=tmp_path).stdout == f"softfinger {VERSION}\n"


def test_the_package_page_has_authors_classifiers_and_no_relative_links(wheel: Path) -> None:
    """Relative links would be broken on the package page, so it has none. The README has only relative ones."""
    from trove_classifiers import classifiers

    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = email.message_from_bytes(archive.read(name))
    assert metadata["Author"] and metadata["Keywords"] and metadata["License-Expression"] == "BSD-3-Clause"
    assert {line.split(", ")[0] for line in metadata.get_all("Project-URL")} >= {"Homepage", "Issues", "Changelog"}
    assert set(metadata.get_all("Classifier")) <= classifiers
    pythons = {line.rpartition(" ")[2] for line in metadata.get_all("Classifier") if re.search(r":: 3\.\d+$", line)}
    assert pythons == {"3.11", "3.12", "3.13"} and metadata["Requires-Python"] == "<3.14,>=3.11"
    page, urls = metadata.get_payload(), PROJECT["project"]["urls"]
    assert isinstance(page, str) and page.startswith("# softfinger") and "](" not in page
    assert all(address.startswith(urls["Homepage"]) for address in urls.values())
    assert "://" not in "".join(re.findall(r"\]\(([^)]+)\)", (ROOT / "README.md").read_text()))


def test_the_installed_wheel_streams(installed: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    device = '[device]\ndriver = "replay"\nrecording = "press-roll-spin-drag"\n'
    rig.write_text(f'{device}[telemetry]\nendpoint = "ipc://{tmp_path}/t"\n')
    run(
        *(installed / "softfinger", "run", "--rig", rig, "--commands", f"ipc://{tmp_path}/c"),
        *("--duration", "1", "--realtime", "off"),
        cwd=tmp_path,
    )


@pytest.mark.exhaustive
def test_a_driver_of_another_package_passes_the_contract_of_the_wheel(installed: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(ROOT / "tests" / "outside_driver", source, ignore=shutil.ignore_patterns("__pycache__"))
    options = "--quiet --no-index --no-deps --no-build-isolation"
    run(
        sys.executable, "-m", "pip", "--python", installed / "python", "install", *options.split(), source, cwd=tmp_path
    )
    result = run(
        *(installed / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", source / "test_lissajous.py"),
        cwd=source,
    )
    assert re.search(r"^\d+ passed", result.stdout, re.MULTILINE), result.stdout
    words = ("run", "--rig", source / "lissajous.toml", "--endpoint", f"ipc://{tmp_path}/t", "--realtime", "off")
    process = run(installed / "softfinger", *words, "--duration", "0.2", cwd=tmp_path)
    assert "device lissajous" in process.stderr and "stopped after 200 ticks" in process.stderr


COMPILES = """
import numpy as np
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR
from softfinger.server.loop.rings import make_ring, take
take(make_ring(4, 2), np.empty((1, 2)))
print(CACHE_DIR.name, len(take.stats.cache_misses))
"""


@pytest.mark.parametrize("first", ["wheel", pytest.param("checkout", marks=pytest.mark.exhaustive)])
def test_a_wheel_and_a_checkout_do_not_compile_the_same_twice(first: str, installed: Path, tmp_path: Path) -> None:
    pythons = [installed / "python", Path(sys.executable)]
    outputs = [
        run(python, "-c", COMPILES, cwd=tmp_path, SOFTFINGER_CACHE_DIR=str(tmp_path / "cache")).stdout.split()
        for python in (pythons if first == "wheel" else reversed(pythons))
    ]
    assert outputs[0][0] == outputs[1][0] and [misses for _, misses in outputs] == ["1", "0"]


@pytest.mark.parametrize("file", ["constraints.txt", "constraints-docs.txt"])
def test_every_pinned_version_has_hashes_and_names_no_host(file: str) -> None:
    text = (ROOT / file).read_text()
    entries = re.split(r"\n(?=\S)", text.strip())
    assert len(entries) > 40
    for entry in entries:
        first, *hashes = [line.strip().removesuffix("\\").strip() for line in entry.splitlines()]
        assert re.fullmatch(r"[a-z0-9-]+==[\w.]+( ; [\w\s.'\"<>=!()]+)?", first), first
        assert hashes, f"{first} has no hash"
        assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", line) for line in hashes), first


def test_every_dependency_is_pinned() -> None:
    pinned = set(re.findall(r"^([a-z0-9-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    wanted = PROJECT["project"]["dependencies"] + PROJECT["project"]["optional-dependencies"]["dev"]
    names = {re.match(r"[A-Za-z0-9_.-]+", line)[0].lower().replace("_", "-") for line in wanted}
    assert not names - pinned, "run `make constraints`"


UNDECLARED = {
    "hatchling": "imported by the build alone, which declares it",
    "llvmlite": "numba's, which names the one version that it works with",
    "pandas": "the caller's, who asks for its tables",
    "playwright": "of the tests, for a measurement in a browser",
    "pytest": "the caller's, whose tests take the plugin and the contract",
}
"""Imported, and no requirement of the package or of an extra for users."""
IMPORTED_AS = {"foxglove": "foxglove-sdk", "rerun": "rerun-sdk", "pylsl": "pylsl", "skfem": "scikit-fem"}
"""Of extras that need not be installed here."""


def test_every_import_is_declared() -> None:
    def plain(requirement: str) -> str:
        return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")

    extras = PROJECT["project"]["optional-dependencies"]
    declared = {plain(requirement) for requirement in PROJECT["project"]["dependencies"]}
    declared |= {plain(requirement) for extra in extras.keys() - {"dev", "docs"} for requirement in extras[extra]}
    installed = packages_distributions()
    undeclared = set()
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        for top in {name.partition(".")[0] for name in imported(file)} - sys.stdlib_module_names - {"softfinger"}:
            if not {plain(package) for package in installed.get(top, [IMPORTED_AS.get(top, top)])} & declared:
                undeclared.add(top)
    assert undeclared == set(UNDECLARED)


def test_the_packages_are_named_the_same_everywhere() -> None:
    build = PROJECT["tool"]["hatch"]["build"]["targets"]
    layers = next(c for c in PROJECT["tool"]["importlinter"]["contracts"] if c["type"] == "layers")["layers"]
    makefile = (ROOT / "Makefile").read_text()
    assert set(build["wheel"]["only-include"]) == set(PACKAGES)
    assert build["wheel"]["sources"] == {package: f"softfinger/{package}" for package in PACKAGES}
    assert set(PACKAGES) <= set(build["sdist"]["only-include"])
    assert set(layers) == {f"softfinger.{package}" for package in PACKAGES}
    assert f"PACKAGES := {' '.join(PACKAGES)}\n" in makefile
    for package in PACKAGES:
        assert (ROOT / ".dev" / "softfinger" / package).resolve() == ROOT / package
        assert (ROOT / ".dev" / OWN_FILE).resolve() == ROOT / "config" / "package.py"
        assert (ROOT / ".dev" / "softfinger" / "__main__.py").resolve() == ROOT / "server" / "main.py"
        assert f"COPY {package} {package}\n" in (ROOT / "Dockerfile").read_text()
        assert f"!{package}\n" in (ROOT / ".dockerignore").read_text()


def imported(path: Path) -> Iterator[str]:
    """Modules a file imports anywhere, `from a import b` as `a`."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield str(node.module)


def test_kernels_import_only_numerics_and_each_other() -> None:
    """The compiler's files in `jit/` run at import or in numba's typing, never in a tick."""
    kernels = ROOT / "proxy" / "kernels"
    files = sorted(kernels.rglob("*.py"))
    assert files
    for path in files:
        allowed = {*KERNEL_IMPORTS, *KERNEL_OWN_IMPORTS, *(["functools"] if path.name == "kernel_table.py" else [])}
        if path.is_relative_to(kernels / "jit"):
            allowed |= sys.stdlib_module_names
        extra = {name for name in imported(path) if not any(f"{name}.".startswith(f"{root}.") for root in allowed)}
        assert extra == set(), path.name


def test_the_import_linter_covers_every_module() -> None:
    """The graph of import-linter contains all our modules: an empty graph would satisfy every contract."""
    code = "import grimp, json; print(json.dumps(sorted(grimp.build_graph('softfinger', cache_dir=None).modules)))"
    modules = set(json.loads(run(sys.executable, "-c", code, cwd=ROOT).stdout))
    for package in PACKAGES:
        for path in sources(package):
            if path.suffix == ".py" and path.name != "__init__.py":
                assert ".".join(("softfinger", *path.with_suffix("").parts)) in modules
