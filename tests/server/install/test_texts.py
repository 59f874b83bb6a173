"""Files that `install` writes, checked by systemd, udev, man and the shells."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from helpers.programs import run_program

from softfinger.config.load import load_rig
from softfinger.config.schema import DeviceConfig
from softfinger.drivers.system.claims import list_claims
from softfinger.drivers.system.rules import explain_permission, install_command, make_udev_rules
from softfinger.server.cli import VERBS, format_completion, main, make_parser
from softfinger.server.install.plan import LIMITS
from softfinger.server.install.texts import make_manual, make_unit

OWN = DeviceConfig(driver="hid", options={"vendor_id": 0xCAFE, "product_id": 0x0042})

# The grammar of udev(7): key, operator, value, separated by commas.
MATCHES = r'(ACTION|SUBSYSTEM|KERNEL|ATTRS?\{\w+\}|ENV\{\w+\})=="[^"]*"'
SETS = r'(GOTO="\w+"|LABEL="\w+"|GROUP="[^"]+"|MODE="0[0-7]{3}"|TAG\+="\w+"|ENV\{\w+\}="\w+")'
LINE = re.compile(rf"({MATCHES}|{SETS})(, ({MATCHES}|{SETS}))*")


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


def run(*words: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | environment
    return run_program([*map(str, words)], env=env)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("root")
    assert main(["install", "--system", "--root", str(folder)]) == 0
    return folder


def test_every_line_is_in_the_grammar_of_udev() -> None:
    """Checked by a regular expression, because udev may be missing."""
    lines = [line for line in make_udev_rules([OWN]).splitlines() if line and not line.startswith("#")]
    assert len(lines) > 10 and not [line for line in lines if not LINE.fullmatch(line)]


def test_every_device_that_a_driver_claims_has_a_rule() -> None:
    rules = make_udev_rules()
    keys = {"usb": ("usb", "ATTR"), "hid": ("hidraw", "ATTRS"), "serial": ("tty", "ATTRS")}
    for claim in list_claims():
        for bus in {claim.bus, "usb"} if claim.driver == "hid" else {claim.bus}:
            subsystem, key = keys[bus]
            number = "" if claim.product is None else rf'{key}\{{idProduct\}}=="[^"]*{claim.product:04x}[^"]*", '
            vendor = rf'SUBSYSTEM=="{subsystem}", .*{key}\{{idVendor\}}=="{claim.vendor:04x}", '
            assert re.search(rf'^{vendor}{number}TAG\+="uaccess"', rules, re.MULTILINE), claim


def test_a_device_of_a_custom_rig_gets_a_rule() -> None:
    assert '"cafe", ATTRS{idProduct}=="0042"' in make_udev_rules([OWN]) and "cafe" not in make_udev_rules()
    assert make_udev_rules(load_rig("woodenhaptics-2019").tables.values()) == make_udev_rules()  # known already
    assert install_command(0xCAFE, 0x0042).endswith("install --system --rig YOUR-RIG.toml")
    assert "install --system`" in explain_permission(0x0403, 0xCB48)


def test_udev_takes_the_rules(root: Path) -> None:
    """Uses `udevadm verify`, or before version 254 `udevadm test` in a mount namespace."""
    udevadm, folder = tool("udevadm"), root / "etc/udev/rules.d"
    if int(re.findall(r"\d+", run(udevadm, "--version").stdout)[0]) >= 254:
        result = run(udevadm, "verify", folder / "70-softfinger.rules")
        assert result.returncode == 0, result.stdout + result.stderr
        return
    script = 'mkdir -p /etc/udev/rules.d && mount --bind "$1" /etc/udev/rules.d && udevadm test /sys/class/net/lo'
    for text, complaints in ((None, 0), ('SUBSYSTEM=="usb", NONSENSE="1"\n', 1)):  # the second must fail
        if text is not None:
            (folder / "71-softfinger-wrong.rules").write_text(text)
        result = run(tool("unshare"), "--mount", "sh", "-c", script, "sh", folder)
        if "Reading rules file: /etc/udev/rules.d/70-softfinger.rules" not in result.stdout + result.stderr:
            pytest.skip(f"udevadm is older than 254, and no name space can be had: {result.stderr.strip()[-200:]}")
        lines = re.findall(r"^/etc/udev/rules\.d/7\d-softfinger.*$", result.stdout + result.stderr, re.MULTILINE)
        assert len(lines) == complaints, lines


@pytest.mark.parametrize("system", [True, False])
def test_systemd_takes_the_unit(root: Path, tmp_path: Path, system: bool) -> None:
    analyze = tool("systemd-analyze")
    odd = tmp_path / "a folder" / "soft$finger%n"
    odd.parent.mkdir()
    odd.write_text("#!/bin/sh\n")
    odd.chmod(0o755)
    for words in ([str(tool("true"))], [str(odd), "run", "--rig", 'a "rig"\\.toml']):
        file = tmp_path / "softfinger.service"
        file.write_text(make_unit(words, system))
        manager = [] if system else ["--user"]
        with TemporaryDirectory() as runtime:  # short path, as units of the machine have sockets in it
            result = run(analyze, *manager, "verify", file, XDG_RUNTIME_DIR=runtime)
        if "Failed to initialize manager" in result.stderr:
            pytest.skip(result.stderr.strip())
        assert (result.returncode, result.stderr) == (0, "")


def test_the_exposure_of_the_service_is_limited(tmp_path: Path) -> None:
    """`systemd-analyze security` rates it at most 2.5 of 10: it needs devices, sockets, real time and compiled code."""
    file = tmp_path / "softfinger.service"
    file.write_text(make_unit([str(tool("true"))], True))
    result = run(tool("systemd-analyze"), "security", "--offline=true", "--threshold=25", file)
    assert result.returncode == 0, result.stdout[-200:] + result.stderr


def test_the_unit_has_the_settings_of_the_daemon() -> None:
    lines = {
        "Type=notify", "WatchdogSec=2s", "Restart=no", "NoNewPrivileges=yes", "ProtectSystem=strict",
        "DevicePolicy=closed", "LimitRTPRIO=95", "LimitMEMLOCK=infinity", "RuntimeDirectory=softfinger",
    }  # fmt: skip
    of_system, of_user = (make_unit(["/bin/softfinger"], system) for system in (True, False))
    assert lines <= set(of_system.splitlines())
    assert "Limit" not in of_user.partition("[Service]")[2]
    assert ["RuntimeDirectoryPreserve" in unit for unit in (of_system, of_user)] == [False, True]


def test_limits_equal_those_of_the_unit() -> None:
    lines = [line.split() for line in LIMITS.splitlines() if not line.startswith("#")]
    assert lines == [["@softfinger", "-", "rtprio", "95"], ["@softfinger", "-", "memlock", "unlimited"]]


def test_sysusers_takes_the_account(root: Path, tmp_path: Path) -> None:
    sysusers = tool("systemd-sysusers")
    (tmp_path / "etc").mkdir()
    run_program([sysusers, f"--root={tmp_path}", str(root / "etc/sysusers.d/softfinger.conf")], check=True)
    assert "\nsoftfinger:" in "\n" + (tmp_path / "etc/group").read_text()
    assert ":/var/lib/softfinger:" in (tmp_path / "etc/passwd").read_text()


def test_the_man_page_has_every_verb_and_option() -> None:
    parser = make_parser().complete()
    text = make_manual(parser).replace(r"\-", "-")
    for name in VERBS:
        assert f".SS softfinger {name}\n" in text
    for option in ("--watcher", "--device-report", "--dry-run", "--print-completion"):
        assert option in text


def test_man_has_no_warning(root: Path) -> None:
    result = run(tool("groff"), "-man", "-ww", "-z", "-Kutf8", root / "usr/local/share/man/man1/softfinger.1")
    assert (result.returncode, result.stderr) == (0, "")


def test_text_is_escaped_for_roff() -> None:
    import argparse

    parser = argparse.ArgumentParser("softfinger", description=r".TH is no 'request', \n neither")
    assert r"\&.TH is no 'request', \en neither" in make_manual(parser)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_take_the_completion(shell: str, tmp_path: Path) -> None:
    script = tmp_path / "softfinger"
    script.write_text(format_completion(shell))
    result = run(tool(shell), "-n", script)
    assert (result.returncode, result.stderr) == (0, "")
    if shell == "bash":
        function = re.search(r"complete .*-F (\w+)", script.read_text())
        for words, wanted in (("inst", "install"), ("run --rig omega", "omega-6")):
            line = f"COMP_WORDS=(softfinger {words}); COMP_CWORD={len(words.split())}; COMP_LINE='softfinger {words}'"
            commands = f"source {shlex.quote(str(script))}; {line}; {function[1]} softfinger; echo ${{COMPREPLY[@]}}"
            assert wanted in run("bash", "-c", commands).stdout.split()
