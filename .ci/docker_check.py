"""Run the steps of the Dockerfile without Docker, in a temporary folder instead of `/`.

Each RUN is executed with the image's paths moved into the temporary folder. Each COPY respects .dockerignore.
COPY --from uses a tar archive with times in whole seconds, like an image layer, and deletes all other files of
the builder, so files that the final image does not copy are also missing here. Then the health check must fail,
the image's command must run, the health check must pass, and the run must not add compiled kernels.

Not covered: the base image (the interpreter of this file replaces it), the installation of Debian packages, and
the change of user.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1]
OWN_PATHS = re.compile(r"(?<![\w./-])/(build|opt/softfinger|var/cache/softfinger|var/lib/softfinger)\b")
SYSTEM_STEPS = ("apt-get", "useradd")


def instructions(text: str) -> list[tuple[str, str]]:
    """Return the instructions of a Dockerfile as (name, arguments), with continued lines joined."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in joined)]


def allowed_in_context(name: str) -> bool:
    """Return True if .dockerignore has an exception (`!`) for this top-level name."""
    rules = (SOURCE / ".dockerignore").read_text().splitlines()
    return f"!{name}" in rules


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Image:
    """State of a build: files in `root`, environment, working folder."""

    def __init__(self, root: Path, base: Path) -> None:
        self.root, self.base = root, base
        self.carried = root.parent / "layers.tar"
        self.settings: dict[str, str] = {}
        self.start_stage()

    def start_stage(self) -> None:
        keep = ("HOME", "LANG", "TERM")
        passed = {k: v for k, v in os.environ.items() if k in keep or k.startswith("PIP_")}
        self.env = passed | {"PATH": f"{self.base / 'bin'}:/usr/local/bin:/usr/bin:/bin"}
        self.workdir = self.root

    def moved(self, text: str) -> str:
        return OWN_PATHS.sub(lambda match: str(self.root) + match.group(0), text)

    def assign(self, rest: str) -> None:
        for word in shlex.split(rest):
            name, _, value = word.partition("=")
            value = re.sub(r"\$\{(\w+)\}", lambda match: (self.settings | self.env)[match.group(1)], value)
            self.env[name] = self.moved(value)

    def run(self, command: list[str], quiet: bool = False) -> int:
        silent = subprocess.DEVNULL if quiet else None
        return subprocess.run(command, cwd=self.workdir, env=self.env, stderr=silent, timeout=600.0).returncode

    def copy_from_builder(self, paths: list[str]) -> None:
        tar = ["tar", "--format=ustar", "-C", str(self.root)]
        if not self.carried.exists():
            subprocess.run([*tar, "-cf", str(self.carried), "opt", "var"], check=True)
            shutil.rmtree(self.root)
            self.root.mkdir()
        subprocess.run([*tar, "-xf", str(self.carried), *(path.lstrip("/") for path in paths)], check=True)

    def copy(self, rest: str) -> None:
        words = shlex.split(rest)
        flags = [word for word in words if word.startswith("--")]
        *sources, target = [word for word in words if not word.startswith("--")]
        if any(flag.startswith("--from=") for flag in flags):
            self.copy_from_builder(sources)
            return
        for name in sources:
            if not allowed_in_context(name):
                raise SystemExit(f"docker-check: COPY {name}: .dockerignore keeps it out of the build context")
            source, to = SOURCE / name, self.workdir / target
            if source.is_dir():
                shutil.copytree(source, to, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                to.mkdir(parents=True, exist_ok=True)  # targets end with /
                shutil.copy2(source, to / source.name)

    def step(self, name: str, rest: str) -> None:
        """Execute one instruction."""
        print(f"docker-check: {name} {rest[:100]}", flush=True)
        if name == "FROM":
            self.start_stage()
        elif name == "WORKDIR":
            self.workdir = Path(self.moved(rest))
            self.workdir.mkdir(parents=True, exist_ok=True)
        elif name == "ENV":
            self.assign(rest)
        elif name == "ARG":
            key, _, value = rest.partition("=")
            self.settings[key] = value
        elif name == "COPY":
            self.copy(rest)
        elif name == "RUN" and any(word in rest for word in SYSTEM_STEPS):
            print("docker-check:   not run: changes the system", flush=True)
        elif name == "RUN" and self.run(["/bin/bash", "-eu", "-o", "pipefail", "-c", self.moved(rest)]):
            raise SystemExit(f"docker-check: this step failed: RUN {rest}")


def check_command(image: Image, steps: list[tuple[str, str]]) -> None:
    """Run ENTRYPOINT and CMD with the health check; no kernel may be compiled again."""
    last = dict(steps)
    command = json.loads(last["ENTRYPOINT"]) + json.loads(last["CMD"]) + ["--realtime", "off"]
    health = json.loads(last["HEALTHCHECK"].partition("CMD ")[2])
    if image.run(health, quiet=True) == 0:
        raise SystemExit("docker-check: the health check passes with no daemon: is one running on this machine?")
    cache = image.root / "var/cache/softfinger"
    compiled = snapshot(cache)
    if not compiled:
        raise SystemExit(f"docker-check: warmup left no kernels in {cache}")
    program = shutil.which(command[0], path=image.env["PATH"]) or command[0]
    daemon = subprocess.Popen([program, *command[1:]], cwd=image.workdir, env=image.env)
    try:
        healthy = image.run(health) == 0
        daemon.send_signal(signal.SIGTERM)  # as `docker stop`
        code = daemon.wait(10.0)
    finally:
        daemon.kill()
    if not healthy or code != 0:
        raise SystemExit(f"docker-check: the daemon ended with {code}, health check passed: {healthy}")
    changed = {name for name, content in snapshot(cache).items() if compiled.get(name) != content}
    if changed:
        raise SystemExit(f"docker-check: compiled again at run time, so warmup missed it: {sorted(changed)}")
    print(f"docker-check: passed, {len(compiled)} files of compiled kernels found again")


def main() -> None:
    steps = instructions((SOURCE / "Dockerfile").read_text())
    with tempfile.TemporaryDirectory(prefix="docker-check-") as scratch:
        base = Path(scratch, "base")
        subprocess.run([sys.executable, "-m", "venv", str(base)], check=True)
        root = Path(scratch, "root")
        root.mkdir()
        image = Image(root, base)
        for name, rest in steps:
            image.step(name, rest)
        check_command(image, steps)


if __name__ == "__main__":
    main()
