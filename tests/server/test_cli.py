"""Command line: exit codes, output streams, errors. `run` starts a program, `called` runs a verb in this process."""

import json
import os
import shlex
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import zmq
from helpers.called import called
from helpers.processes import COMMAND
from helpers.programs import run_program

from softfinger.server.cli import VERBS, make_parser
from softfinger.server.recording.results import read_results
from softfinger.tools.bench.options import KINDS

FREE = ["--endpoint", "tcp://127.0.0.1:*"]
"""Option for `run`: a free port."""
SIMULATE = ["simulate", "--scene", "paper-plane", "--poses", "tap"]
LOOP = ["bench", "loop", "--seconds", "600"]


def run(*words, timeout=300):
    return run_program([*COMMAND, *words], timeout=timeout)


def test_version():
    assert run("--version").stdout == f"softfinger {version('softfinger')}\n"


BEGIN = """
import gc, os, sys
from softfinger.server import cli
early = "numpy" in sys.modules
sys.argv = ["softfinger", "scenes"]
cli.main()
print(early, os.environ["OPENBLAS_NUM_THREADS"], gc.isenabled(), gc.get_freeze_count() > 0)
"""


def test_garbage_collection_is_on_when_a_verb_runs():
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    outcome = run_program([sys.executable, "-c", BEGIN], env=environment)
    assert outcome.stdout.splitlines()[-1:] == ["False 1 True True"], outcome.stderr


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("simulat --poses tap", "(did you mean 'simulate'?)\n"),
        ("bench stp", "(did you mean 'step'?)\n"),
        ("run --secne sphere", "unrecognized arguments: --secne (did you mean '--scene'?) sphere"),
        ("run --rte=500", "unrecognized arguments: --rte=500 (did you mean '--rate'?)"),
        ("bench step --blcoks 2", "unrecognized arguments: --blcoks (did you mean '--blocks'?) 2"),
        ("check paper-plane --qxz", "unrecognized arguments: --qxz\n"),
    ],
)
def test_a_similar_name_is_suggested(line, message):
    outcome = called(*line.split())
    assert outcome.returncode == 2 and message in outcome.stderr and outcome.stdout == ""


@pytest.mark.parametrize("line", ["{} scenes", "scenes {}", "bench step {}", "bench {} step"])
@pytest.mark.parametrize("flag", ["-v", "--verbose", "-q", "--quiet"])
def test_verbosity_flags_work_before_and_after_a_verb(line, flag):
    args = make_parser().parse_args(line.format(flag).split())
    verbose = flag in ("-v", "--verbose")
    assert (args.verbose, args.quiet) == (verbose, not verbose)


def test_quiet_leaves_warnings_and_results(tmp_path):
    words = ["run", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off", "--realtime", "off", "--duration", "0.1"]
    outcome = run(*words, "-q")
    assert outcome.returncode == 0 and outcome.stderr == ""
    outcome = called("check", "nothing", "-q")
    assert outcome.returncode == 2 and "nothing" in outcome.stdout + outcome.stderr


def test_completion_lists_shipped_names(tmp_path):
    (tmp_path / "spherical.toml").touch()
    script = called("--print-completion", "bash").stdout
    completions = {
        "run --scene sph": ["sphere", "spherical.toml"],
        "materials sili": ["silicone", "silicone-tip"],
        "experiment weight": ["weight-of-a-box"],
        "info press-a-b": ["press-a-button"],
    }
    for words, wanted in completions.items():
        at = len(words.split())
        script_end = f"COMP_WORDS=(softfinger {words}); COMP_CWORD={at}; _shtab_softfinger; echo ${{COMPREPLY[@]}}"
        outcome = run_program(["bash", "-c", f"{script}\n{script_end}"], cwd=tmp_path, check=True)
        assert outcome.stdout.split() == wanted


HELP = """
import contextlib, io, sys
from softfinger.server.cli import VERBS, run_verb
from softfinger.tools.bench.options import KINDS
for words in [["--help"], *([verb, "--help"] for verb in VERBS), *(["bench", kind, "--help"] for kind in KINDS)]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        run_verb(words)
    print(*words, {"numpy", "numba", "scipy", "rich", "zmq"} & set(sys.modules))
"""


def test_help_imports_no_compiler():
    outcome = run_program([sys.executable, "-c", HELP], check=True)
    words = ["", *(f"{verb} " for verb in VERBS), *(f"bench {kind} " for kind in KINDS)]
    assert outcome.stdout.splitlines() == [f"{prefix}--help set()" for prefix in words]


def test_run_for_a_duration_logs_plain_lines():
    result = run("run", "--duration", "0.2", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "auto")
    assert result.returncode == 0 and result.stdout == ""
    for piece in (
        "paper-plane",
        "replay",
        "tcp://127.0.0.1:",
        "monitor --endpoint",
        "real time:",
        "stopped after 200 ticks",
    ):
        assert piece in result.stderr
    assert "\r" not in result.stderr and "\x1b" not in result.stderr


@pytest.mark.parametrize(
    ("words", "code", "pieces"),
    [
        (["run", "--rate", "7"], 2, ["command line --rate", "7", "100"]),
        (["run", "--scene", "moon"], 2, ["moon", "paper-plane"]),
        (["run", *FREE, "--recording", "nothing"], 3, ["nothing", "tap"]),
        (["run", *FREE, "--device", "omega"], 4, ["omega", "replay"]),
        (["run", *FREE, "--rig", "omega-3", "--once"], 2, ["--once", "forcedimension", "--device replay"]),
        (["run", "--endpoint", "tcp://0.0.0.0:5555"], 2, ["0.0.0.0", "127.0.0.1"]),
        (["run", "--duration", "-1"], 2, ["duration"]),
        (["run", *FREE, "--record", "nowhere/trial.mcap"], 2, ["--record nowhere/trial.mcap", "does not exist"]),
        ([*SIMULATE, "--out", "x.doc"], 3, ["x.doc", ".csv", ".mcap"]),
        ([*SIMULATE, "--out", "x.csv", "--method", "zxy"], 2, ["zxy", "euler_zxz"]),
        (["fly"], 2, ["fly", "simulate"]),
        ([*LOOP, "--plot", "out.txt"], 2, ["--plot: out.txt: a figure is .png or .svg by its file name"]),
        ([*LOOP, "--plot", "no/such/out.png"], 2, ["--plot: no/such/out.png: the folder no/such does not exist"]),
        (["bench", "step", "--features", "tosion*"], 2,
         ["--features 'tosion*': no feature has such a name", "torsion linear"]),
    ],
)  # fmt: skip
def test_bad_words_give_one_clear_error(words, code, pieces):
    outcome = called(*words)
    assert outcome.returncode == code, outcome.stderr
    assert all(piece in outcome.stderr for piece in pieces), outcome.stderr
    assert "Traceback" not in outcome.stderr


def test_an_endpoint_in_use_gives_exit_code_7():
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        result = run("run", "--endpoint", f"tcp://127.0.0.1:{port}", "--duration", "1")
    assert result.returncode == 7 and str(port) in result.stderr


PEAK = """
import sys
from softfinger.server.cli import main
code = main(sys.argv[1:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(code, int(peak.split()[1]) // 1024)
"""


@pytest.mark.exhaustive  # ten minutes of ticks, written three times
@pytest.mark.parametrize("ending", [".csv", ".npz", ".mcap"])
def test_a_long_run_needs_bounded_memory(ending, tmp_path):
    t = np.arange(60_001) * 0.01
    poses = np.column_stack(
        [t, 0.01 * np.sin(t), 0.0 * t, 0.0095 + 0.001 * np.sin(7.0 * t), 1.0 + 0.0 * t, *[0.0 * t] * 3]
    )
    header = "t,x,y,z,qw,qx,qy,qz"
    np.savetxt(tmp_path / "poses.csv", poses, fmt="%.9g", delimiter=",", header=header, comments="")
    words = ["simulate", "--scene", "paper-plane", "--poses", "poses.csv", "--out", f"out{ending}"]
    outcome = run_program([sys.executable, "-c", PEAK, *words], cwd=tmp_path, check=True)
    code, peak = map(int, outcome.stdout.splitlines()[-1].split())
    assert code == 0 and "600001 ticks" in outcome.stdout
    assert peak <= 250


@pytest.mark.parametrize("ending", [".csv", ".npz", ".parquet"])
def test_a_shipped_recording_is_read_by_its_name(ending, tmp_path):
    outcome = called("info", "tap")
    assert outcome.returncode == 0 and "229 poses, 0 to 228, 2.280 s" in outcome.stdout
    assert "x 0 to 0, y 0 to 0, z " in outcome.stdout and "unknown" not in outcome.stdout
    poses, out = tmp_path / f"poses{ending}", tmp_path / "out.csv"
    assert called("export", "tap", "--out", str(poses)).returncode == 0
    if ending != ".parquet":
        assert called(*SIMULATE, "--out", str(out)).returncode == 0
        words = ["tap", "--scene", "paper-plane", "--against", str(out)]
        assert called("replay", *words).returncode == 0
        before = out.read_bytes()
        assert called("simulate", "--poses", str(poses), "--out", str(out)).returncode == 0
        assert out.read_bytes() == before
        assert "sliding" in called("info", str(out)).stdout
    outcome = called("info", "tpa")
    assert outcome.returncode == 3
    assert "'tpa' is neither a file nor a shipped recording (did you mean 'tap'?)" in outcome.stderr


def test_simulate_is_deterministic_and_takes_another_rate(tmp_path):
    for program, name in ((run, "a.csv"), (called, "b.csv")):
        assert program(*SIMULATE, "--out", str(tmp_path / name)).returncode == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    out = tmp_path / "fast.npz"
    called(*SIMULATE, "--out", str(out), "--rate", "4000")
    assert len(read_results(out)) == 4 * 2280 + 1


def test_output_into_a_closed_pipe_is_no_error():
    reader, writer = os.pipe()
    process = subprocess.Popen([*COMMAND, "schema", "telemetry"], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    os.close(reader)
    assert process.wait(60) == 0 and process.stderr.read() == ""
    process.stderr.close()


LONG = "x" * 300


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("check paper-plane >&-", 0, ""),
        ("check paper-plane 2>&-", 0, ""),
        ("schema telemetry >/dev/full", 11, "No space left on device"),
        ("run --duration 0.2 --realtime off --endpoint tcp://127.0.0.1:* <&- >&- 2>&-", 0, ""),
        ("run --duration 0.2 --realtime off --endpoint tcp://127.0.0.1:* 2>&1 | head -1", 0, "--view"),
        (f"check {LONG}", 2, "no scene, rig or experiment is named"),
        (f"check {LONG}.toml", 2, "File name too long"),
        (f"run --endpoint tcp://127.0.0.1:* --recording {LONG}.csv", 3, "File name too long"),
        (f"record --poses {LONG}.csv --timeout 0.1 --endpoint ipc:///nowhere/x", 9, "no telemetry"),
        ("NUMBA_DISABLE_JIT=1 run --endpoint tcp://127.0.0.1:*", 5, "NUMBA_DISABLE_JIT is set"),
    ],
)
def test_an_unusable_stream_name_or_environment_gives_one_line(line, code, message):
    variables = "NUMBA_DISABLE_JIT=1 " * line.startswith("NUMBA")
    words = ["bash", "-c", f"set -o pipefail; {variables}{shlex.join(COMMAND)} {line.removeprefix(variables)}"]
    outcome = run_program(words)
    assert outcome.returncode == code, outcome.stderr
    assert "Traceback" not in outcome.stderr and message in outcome.stdout + outcome.stderr
    assert len([row for row in outcome.stderr.splitlines() if row.startswith("softfinger:")]) <= 1


def test_closed_streams_do_not_become_a_device(tmp_path):
    code = (
        "import os, sys\nfor fd in (0, 1, 2): os.close(fd)\nsys.stdout = sys.stderr = None\n"
        "from softfinger.server.cli import open_streams\nopen_streams()\n"
        "fd = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT)\n"
        "os.write(fd, b'%d' % fd); os.write(1, b'out'); os.write(2, b'err'); print('out')\n"
    )
    node = tmp_path / "node"
    subprocess.run([sys.executable, "-c", code, str(node)], check=True)
    assert int(node.read_text()) > 2


@pytest.mark.parametrize("words", [["check", "paper-plane"], ["run"]])
def test_a_low_limit_of_open_files_is_reported(words):
    """With a limit of eight open files, one line reports how many are needed; ZeroMQ would abort."""
    command = f"ulimit -n 8; exec {shlex.join([*COMMAND, *words])}"
    outcome = run_program(["bash", "-c", command])
    assert outcome.returncode == 11, outcome.stderr
    assert outcome.stderr == "softfinger: this process may open 8 files, but needs 64: raise `ulimit -n`\n"


@pytest.mark.plain
def test_bench_of_the_step_prints_json(tmp_path, monkeypatch):
    from softfinger.tools.bench import step

    monkeypatch.setattr(step, "ROUNDS", 2)
    poses = step.make_touching_poses
    monkeypatch.setattr(step, "make_touching_poses", lambda scene: poses(scene, 50))
    monkeypatch.setattr(step, "measure_reference_ns", lambda: 100.0)  # the reference chain is fast only when compiled
    plot = tmp_path / "plot.png"
    outcome = called("bench", "step", "--json", "--plot", str(plot), "--blocks", "2", "--features", "torsion linear")
    assert outcome.returncode == 0, outcome.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    result = json.loads(outcome.stdout)
    # the costs of a shipped scene, its variants without one part each, and one feature; all in contact
    assert len(result["variants"]) == 5 and {"ns_per_step", "cpu_ns_per_step"} <= result["variants"][0].keys()
    assert all(row["in_contact"] == 1.0 for row in result["variants"])
    (feature,) = result["features"]
    assert feature["feature"] == "torsion linear" and feature["in_contact"] == 1.0
    assert feature["reference_ns"] > 0.0 and {"ns_per_step", "marginal_ns"} <= feature.keys()


def test_run_is_drawn(tmp_path):
    drawn = []
    for name in ("one.svg", "two.svg"):
        outcome = called(*SIMULATE, "--out", str(tmp_path / "out.csv"), "--plot", str(tmp_path / name))
        assert outcome.returncode == 0, outcome.stderr
        drawn.append((tmp_path / name).read_text())
    assert drawn[0] == drawn[1]
    assert all(f">{word}</text>" in drawn[0] for word in ("penetration", "norm", "torsion", "rolling", "time [s]"))
