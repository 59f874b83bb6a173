"""Planted mistakes, which tests have to catch: one at a time, in a copy of the program.

    python tests/mutants.py [--only TEXT]

`mutants.toml` lists them. Tests run as in tests/run.py: those marked `plain` with kernels as plain Python, all others
compiled. A failing test has caught the mistake; a test that cannot run has not. All tests are first run without a
mistake. The kernel cache is in the folder of the copy and is removed with it.
"""

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from run import ENVIRONMENT

ROOT: Final = Path(__file__).resolve().parents[1]
LIMIT_S: Final = 300.0
"""Limit for the tests of one mistake, plain or compiled. A mistake may cause an endless loop."""
FAILED, NONE_RAN = 1, (0, 5)
"""Exit codes of pytest: a test failed; all passed, or none was found. All other codes are errors."""
CAUGHT, SURVIVED, LATE, ERROR = "caught", "SURVIVED", "time out", "ERROR"


class Mutant(NamedTuple):
    """Mistake: `old` is replaced by `new` in `file`, and `tests` must catch it."""

    file: str
    old: str
    new: str
    mistake: str
    tests: list[str]

    def __str__(self) -> str:
        return f"{self.file}: {self.mistake}"


class Outcome(NamedTuple):
    """Result of a test run: one of the words above, its duration, and pytest's output."""

    word: str
    seconds: float
    output: str


def read(only: str = "") -> list[Mutant]:
    """Return the mistakes with `only` in their file or description."""
    listed = tomllib.loads((ROOT / "tests" / "mutants.toml").read_text("utf-8"))
    mutants = [Mutant(file, **table) for file, tables in listed.items() for table in tables]
    return [mutant for mutant in mutants if only in mutant.file or only in mutant.mistake]


def copy_to(folder: Path) -> None:
    """Copy the tracked files of this repository in their current state; links are preserved."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, names.decode().split("\0")):
        if os.path.lexists(ROOT / name):  # skip removed files
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)


class Copy:
    """Copy of the program in `folder`, imported by tests that run there."""

    def __init__(self, folder: Path) -> None:
        folder.chmod(0o755)  # some tests switch to another user, which needs access
        self.folder = folder / "copy"
        copy_to(self.folder)
        self._environment = ENVIRONMENT | {
            "PYTHONPATH": str(self.folder / ".dev"),
            "SOFTFINGER_CACHE_DIR": str(folder / "kernels"),
            "SOFTFINGER_TEST_WAIT_S": "30",
        }
        command = [sys.executable, "-c", "import softfinger.server.cli as it; print(it.__file__)"]
        process = subprocess.run(
            command, cwd=self.folder, env=self._environment, capture_output=True, text=True, check=True
        )
        if Path(process.stdout.strip()).resolve() != self.folder.resolve() / "server" / "cli.py":
            raise SystemExit(f"softfinger is imported from {process.stdout.strip()}, not from the copy")

    def test(self, tests: Sequence[str], limit_s: float | None = LIMIT_S) -> Outcome:
        """Run tests until one fails."""
        begun = time.monotonic()
        # Other files have no `plain` test, and may require machine code (tests/conftest.py).
        plain = [test for test in tests if "plain" in (self.folder / test.partition("::")[0]).read_text("utf-8")]
        outcome = Outcome(SURVIVED, 0.0, "")
        for marks, chosen, more in (("plain", plain, {"NUMBA_DISABLE_JIT": "1"}), ("not plain", list(tests), {})):
            if chosen and outcome.word == SURVIVED:
                outcome = self._run(["-m", f"{marks} and not exhaustive", *chosen], more, limit_s)
        return outcome._replace(seconds=time.monotonic() - begun)

    def _run(self, words: list[str], more: dict[str, str], limit_s: float | None) -> Outcome:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *words]
        with tempfile.TemporaryFile("w+") as output, subprocess.Popen(  # a pipe would have to be read to its end
            command, cwd=self.folder, env=self._environment | more, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        ) as process:  # fmt: skip
            try:
                code = process.wait(limit_s)
                word = CAUGHT if code == FAILED else SURVIVED if code in NONE_RAN else ERROR
            except subprocess.TimeoutExpired:
                word = LATE
            finally:
                end_session(process.pid)
            output.seek(0)
            return Outcome(word, 0.0, output.read())

    def try_out(self, mutant: Mutant, number: int) -> Outcome:
        """Plant a mistake, run its tests and undo it. `number` distinguishes mistakes in the same file."""
        path = self.folder / mutant.file
        text, before = path.read_text("utf-8"), path.stat()
        if (count := text.count(mutant.old)) != 1:
            return Outcome(ERROR, 0.0, f"what it takes the place of is there {count} times, must be once")
        try:
            path.write_text(text.replace(mutant.old, mutant.new), "utf-8")
            # Python matches bytecode to its source by size and modification time in seconds.
            os.utime(path, (before.st_atime, int(before.st_mtime) + number))
            return self.test(mutant.tests)
        finally:
            path.write_text(text, "utf-8")
            os.utime(path, (before.st_atime, before.st_mtime))


def end_session(leader: int) -> None:
    """Kill the remaining processes of a session: daemons of tests have separate process groups."""
    for pid in os.listdir("/proc"):
        with contextlib.suppress(ValueError, OSError):  # not a process, or no longer one
            if os.getsid(int(pid)) == leader:
                os.kill(int(pid), signal.SIGKILL)


def tell(results: Sequence[tuple[Mutant, Outcome]], seconds: float) -> None:
    """Print counts by folder, and each mistake that was not caught."""
    folders = Counter(mutant.file.partition("/")[0] for mutant, _ in results)
    caught = Counter(mutant.file.partition("/")[0] for mutant, outcome in results if outcome.word == CAUGHT)
    print(f"\nin {seconds:.0f} s:")
    for folder, count in sorted(folders.items()):
        print(f"  {folder:<9}{caught[folder]:3} of {count} caught")
    for mutant, outcome in results:
        if outcome.word != CAUGHT:
            print(f"  {outcome.word}: {mutant}\n    by {' '.join(mutant.tests)}")
            if outcome.word == ERROR:
                print("\n".join(f"    {line}" for line in outcome.output.strip().splitlines()[-12:]))


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Plant each mistake of tests/mutants.toml and see it caught.")
    parser.add_argument("--only", default="", metavar="TEXT", help="those whose file or description has this in it")
    args = parser.parse_args(words)
    begun, mutants, results = time.monotonic(), read(args.only), list[tuple[Mutant, Outcome]]()
    if not mutants:
        raise SystemExit(f"--only {args.only}: no mistake has this in its file or its description")
    with tempfile.TemporaryDirectory(prefix="softfinger-mutants-") as folder:
        copy = Copy(Path(folder))
        right = copy.test(sorted({test for mutant in mutants for test in mutant.tests}), limit_s=None)
        if right.word != SURVIVED:
            print(right.output)
            raise SystemExit("these tests do not pass without a mistake: nothing they say of one would count")
        print(f"without a mistake all pass, {right.seconds:.1f} s", flush=True)
        for number, mutant in enumerate(mutants, 1):
            outcome = copy.try_out(mutant, number)
            results.append((mutant, outcome))
            print(f"[{number}/{len(mutants)}] {outcome.word:<8} {outcome.seconds:5.1f} s  {mutant}", flush=True)
    tell(results, time.monotonic() - begun)
    return 0 if all(outcome.word == CAUGHT for _, outcome in results) else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
