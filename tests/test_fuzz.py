"""Readers accept arbitrary bytes or refuse them with one clear error: stored cases, and new ones for a limited time.

A failure prints how to store its bytes in tests/corpus, from where every run tests them again. SOFTFINGER_FUZZ_SECONDS
is the time for each target, SOFTFINGER_FUZZ_SEED the seed.
"""

import os
import random
import sys
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Final

import pytest
from helpers import fuzzing
from helpers.programs import run_program

pytestmark = pytest.mark.plain

HERE: Final = Path(__file__).parent
CORPUS: Final = HERE / "corpus"
FOUND: Final = sorted(path for path in CORPUS.glob("*/*") if path.is_file())
SECONDS: Final = float(os.environ.get("SOFTFINGER_FUZZ_SECONDS", "4"))
SEED: Final = int(os.environ.get("SOFTFINGER_FUZZ_SEED", "0")) or int.from_bytes(os.urandom(4))
TARGETS: Final = sorted(fuzzing.targets())
FIRST: Final = 100
"""Number of mutations in every run, which are always the same."""


def test_every_folder_of_the_corpus_is_a_target() -> None:
    assert {path.parent.name for path in FOUND} <= set(TARGETS)


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_bytes_found_by_fuzzing_are_accepted_or_refused(path: Path, tmp_path: Path) -> None:
    target = fuzzing.targets()[path.parent.name]
    assert not fuzzing.verdict(target, tmp_path / f"input{target.ending}", path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_the_first_mutations_are_accepted_or_refused(name: str, tmp_path: Path) -> None:
    target, chance = fuzzing.targets()[name], random.Random(name)
    seeds, path = fuzzing.seeds_of(target), tmp_path / f"input{target.ending}"
    path.write_bytes(seeds[0])
    target.take(path, seeds[0])  # accepted; otherwise all mutations would be refused for the same reason
    for _ in range(FIRST):
        data = fuzzing.mutated(seeds, chance)
        assert not fuzzing.verdict(target, path, data), data


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", TARGETS)
def test_random_bytes_are_accepted_or_refused(name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "helpers.fuzzing", name, f"{SECONDS}", f"{SEED}", folder]
        environment = os.environ | {"PYTHONPATH": str(HERE), "NUMBA_DISABLE_JIT": "1"}
        process = run_program(command, cwd=HERE, env=environment, timeout=20.0 * SECONDS + 300.0)
        (last,) = Path(folder).glob("input*")
        data = last.read_bytes()
    if process.returncode != 0:
        saved = CORPUS / name / sha256(data).hexdigest()[:12]
        saved.parent.mkdir(parents=True, exist_ok=True)
        saved.write_bytes(data)
        pytest.fail(
            f"seed {SEED}: code {process.returncode}\n{process.stdout}{process.stderr[-2000:]}\nkept as {saved}"
        )
    assert int(process.stdout.split()[-1]) > 0
