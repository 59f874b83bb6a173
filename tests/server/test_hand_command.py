"""The command `hand` to a real daemon: the fingertip goes there and presses, and stays when nobody asks any more."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator

import pytest

from softfinger.config.errors import CommandRefused
from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.wire.control import AsyncControl

pytestmark = pytest.mark.real_time

WAIT_S = 60.0
ENDPOINTS = {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "tcp://127.0.0.1:*"}


def eventually(true: Callable[[], bool]) -> bool:
    until = time.monotonic() + WAIT_S
    while not true():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def has_ticked(client: Client) -> bool:
    """Whether there is a state to be asked for."""
    try:
        client.get_state()
    except CommandRefused:
        return False
    return True


@pytest.fixture(scope="module")
def daemon() -> Iterator[Daemon]:
    rig = load_rig("simulated-hand", ENDPOINTS | {"servo.realtime": "off"})
    with Daemon(rig, load_scene("paper-plane"), scene_name="paper-plane") as running:
        running.start()
        with Client(running.publisher.endpoint, str(running.commands_endpoint), timeout_s=WAIT_S) as first:
            assert eventually(lambda: has_ticked(first))
        yield running


@pytest.fixture
def client(daemon: Daemon) -> Iterator[Client]:
    with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as client:
        yield client


def test_it_presses_and_stays_after_the_client_has_gone(daemon: Daemon, client: Client) -> None:
    """5 mm above the plane for the probe is 5 mm of intended depth: force, and still force for the next client."""
    assert client.describe()["fingers"][0]["led"] is True
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 0.5)
    client.close()
    with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as other:
        ticks = other.get_state().sequence
        assert eventually(lambda: other.get_state().sequence > ticks + 500)
        assert other.get_state().force[2] > 0.5


def test_held_it_goes_on_pressing(client: Client) -> None:
    """Its goal is the one that it was led to, deeper than the contact lets it come; led to that it stays."""
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 1.0)
    before = client.get_state()
    assert eventually(lambda: client.get_state().sequence > before.sequence + 500)  # 16 time constants of its way
    rests = client.get_state()
    held = client.hold()
    assert held.position_m == pytest.approx((0.0, 0.0, 0.005), abs=1e-6) and rests.position[2] > 0.0055
    client.hand(held.position_m, held.orientation_wxyz)
    assert eventually(lambda: client.get_state().sequence > rests.sequence + 500)
    assert client.get_state().force[2] == pytest.approx(rests.force[2], abs=1e-3)


def test_it_is_told_when_it_begins_and_ends_and_not_between(daemon: Daemon, client: Client) -> None:
    """A stroke of thirty requests is two events."""
    client.hand(release=True)
    with client.subscribe(("event",), timeout_s=WAIT_S) as events:
        assert eventually(lambda: client.mark("begin") is not None and events.receive(0.1) is not None)
        for k in range(30):
            client.hand((0.001 * k, 0.0, 0.02))
        client.hand(release=True)
        client.mark("end")
        told = []
        while (event := next(events).data)["kind"] != "mark" or event["label"] != "end":
            if event["kind"] == "command":
                told.append((event["name"], event["what"]))
    assert told == [("hand", {"finger": "", "led": True}), ("hand", {"finger": "", "led": False})]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({}, "bad_params: give either position_m"),
        ({"position_m": [0, 0, 0.01], "release": True}, "bad_params: give either position_m"),
        ({"position_m": [0, 0, 3]}, "bad_params: hand: position_m = .* is out of reach"),
        ({"position_m": [0, 0, float("nan")]}, "bad_params: hand"),
        ({"position_m": [0, 0, 0.02], "finger": "toe"}, "bad_params: no finger is 'toe'"),
    ],
)
def test_bad_requests_move_nothing(client: Client, asked: dict[str, object], said: str) -> None:
    """Each is declined with what is wrong."""
    with pytest.raises(CommandRefused, match=said):
        client.ask("hand", asked)


def test_a_replay_has_no_hand_to_lead(endpoints: tuple[str, str]) -> None:
    """Refused, with the rig that has one; for asyncio, too."""

    async def ask() -> None:
        async with AsyncControl(endpoints[1], timeout_s=WAIT_S) as control:
            await control.hand((0.0, 0.0, 0.01))

    with pytest.raises(CommandRefused, match=r"refused: no program leads the hand on replay.*--rig simulated-hand"):
        asyncio.run(ask())
