"""Command `hand` sent to a real daemon: the fingertip moves, presses, and stays after the client disconnects."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import pytest
from helpers.pages import running
from helpers.waits import eventually

from softfinger.config.errors import CommandRefused
from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.wire.control import AsyncControl

pytestmark = pytest.mark.real_time

WAIT_S = 60.0


def has_ticked(client: Client) -> bool:
    try:
        client.get_state()
    except CommandRefused:
        return False
    return True


@pytest.fixture(scope="module")
def daemon() -> Iterator[Daemon]:
    with (
        running("simulated-hand", "paper-plane") as daemon,
        Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as first,
    ):
        assert eventually(lambda: has_ticked(first))
        yield daemon


def test_the_hand_presses_after_the_client_disconnects(daemon: Daemon, client: Client) -> None:
    assert client.describe()["fingers"][0]["led"] is True
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 0.5)
    client.close()
    with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as second:
        ticks = second.get_state().sequence
        assert eventually(lambda: second.get_state().sequence > ticks + 500)
        assert second.get_state().force[2] > 0.5


def test_a_held_hand_still_presses(client: Client) -> None:
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 1.0)
    before = client.get_state()
    assert eventually(lambda: client.get_state().sequence > before.sequence + 500)  # 16 time constants of the motion
    rests = client.get_state()
    target = client.hold()
    assert target.position_m == pytest.approx((0.0, 0.0, 0.005), abs=1e-6) and rests.position[2] > 0.0055
    client.hand(target.position_m, target.orientation_wxyz)
    assert eventually(lambda: client.get_state().sequence > rests.sequence + 500)
    assert client.get_state().force[2] == pytest.approx(rests.force[2], abs=1e-3)


def test_events_report_only_start_and_end_of_a_lead(daemon: Daemon, client: Client) -> None:
    client.hand(release=True)
    with client.subscribe(("event",), timeout_s=WAIT_S) as events:
        assert eventually(lambda: client.mark("begin") is not None and events.receive(0.1) is not None)
        for k in range(30):
            client.hand((0.001 * k, 0.0, 0.02))
        client.hand(release=True)
        client.mark("end")
        commands = []
        while (event := next(events).data)["kind"] != "mark" or event["label"] != "end":
            if event["kind"] == "command":
                commands.append((event["name"], event["what"]))
    assert commands == [("hand", {"finger": "", "led": True}), ("hand", {"finger": "", "led": False})]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "bad_params: give either position_m"),
        ({"position_m": [0, 0, 0.01], "release": True}, "bad_params: give either position_m"),
        ({"position_m": [0, 0, 3]}, "bad_params: hand: position_m = .* is outside the workspace"),
        ({"position_m": [0, 0, float("nan")]}, "bad_params: hand"),
        ({"position_m": [0, 0, 0.02], "finger": "toe"}, "bad_params: no finger is 'toe'"),
    ],
)
def test_bad_requests_move_nothing(client: Client, parameters: dict[str, object], message: str) -> None:
    with pytest.raises(CommandRefused, match=message):
        client.ask("hand", parameters)


def test_a_replay_has_no_hand_to_lead(endpoints: tuple[str, str]) -> None:
    async def ask() -> None:
        async with AsyncControl(endpoints[1], timeout_s=WAIT_S) as control:
            await control.hand((0.0, 0.0, 0.01))

    with pytest.raises(
        CommandRefused, match=r"refused: replay.* has no hand that a program can move.*--rig simulated-hand"
    ):
        asyncio.run(ask())
