"""Asks Unitree's motion switcher to end the service that commands the motors. Needs the extra `robot`."""

from __future__ import annotations

import json
import time
from typing import Any

from hdmi.deploy.dds import (
    Bus,
    Identity,
    Lease,
    Reader,
    Request,
    RequestHeader,
    RequestPolicy,
    Response,
    ResponseHeader,
    Status,
    writer_of,
)  # fmt: skip
from hdmi.deploy.robot import RobotError

_REQUESTS, _RESPONSES = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
CHECK_MODE, RELEASE_MODE = 1001, 1003


class MotionSwitcher:
    """Asks the robot's motion switcher."""

    def __init__(self, bus: Bus):
        self._reader = Reader(bus, bus.topic(_RESPONSES, Response))
        self._writer = writer_of(bus, bus.topic(_REQUESTS, Request))

    def _call(self, api: int, timeout: float) -> Any:
        """What it answers, or None if it does not."""
        until = time.monotonic() + timeout
        while time.monotonic() < until:
            header = RequestHeader(Identity(time.monotonic_ns(), api), Lease(0), RequestPolicy(0, False))
            self._writer.write(Request(header, "{}", []))
            again = min(time.monotonic() + 0.5, until)  # a request sent before discovery is through is lost
            while (left := again - time.monotonic()) > 0:
                for answer in self._reader.take(left):
                    if answer.header.identity == header.identity:
                        return answer
        return None

    def release(self, timeout: float) -> None:
        """Ends the service that commands the motors, if there is one.

        Raises:
            RobotError: if the switcher does not answer, or the service goes on.
        """
        until, name = time.monotonic() + timeout, "?"
        while (left := until - time.monotonic()) > 0:
            answer = self._call(CHECK_MODE, left)
            if answer is None:
                break
            name = json.loads(answer.data or "{}").get("name", "")
            if answer.header.status.code == 0 and not name:
                return
            self._call(RELEASE_MODE, max(until - time.monotonic(), 0.1))
        said = "does not answer" if name == "?" else f"does not end the robot's own service {name!r}"
        raise RobotError(
            f"the motion switcher {said} within {timeout:g} s; press L2 and R2 (debug mode), and give release=false"
        )


class SimulatedSwitcher:
    """The motion switcher of a simulated robot.

    Args:
        mode: name of the service that is running, empty for none.
    """

    def __init__(self, bus: Bus, mode: str):
        self.mode = mode
        self._reader = Reader(bus, bus.topic(_REQUESTS, Request))
        self._writer = writer_of(bus, bus.topic(_RESPONSES, Response))

    def answer(self) -> None:
        """Answers what was asked since the last call."""
        for request in self._reader.take(0.0):
            api = request.header.identity.api_id
            if api == RELEASE_MODE:
                self.mode = ""
            data = json.dumps({"form": "0", "name": self.mode}) if api == CHECK_MODE else ""
            self._writer.write(Response(ResponseHeader(request.header.identity, Status(0)), data, []))
