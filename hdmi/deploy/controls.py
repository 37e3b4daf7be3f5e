"""How an operator asks for states: keys of a terminal, a gamepad, and signals that end everything in damping."""

from __future__ import annotations

import os
import select
import signal
import struct
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from types import FrameType, TracebackType
from typing import Any, Protocol

QUIT = "quit"  # damping, and the end of the run
KEYS = {"s": "to_start", "r": "run", "h": "hold", " ": "damping", "d": "damping", "\x1b": "damping", "q": QUIT}
BUTTONS = {0: "to_start", 3: "run", 2: "hold", 1: "damping", 8: QUIT}  # A, Y, X, B, back


class Controls(Protocol):
    """Where requests come from."""

    def requests(self) -> list[str]:
        """States asked for since the last call, or `quit`."""
        ...

    def close(self) -> None:
        """Puts the terminal or the device back as it was."""
        ...


class Keyboard:
    """Keys of the terminal that standard input is, each without return; nothing where it is no terminal."""

    def __init__(self, keys: Mapping[str, str] = KEYS):
        self.keys = keys
        self._before: list[Any] | None = None
        if sys.stdin is not None and sys.stdin.isatty():
            import termios
            import tty

            self._fd = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)

    @property
    def active(self) -> bool:
        """Whether there is a terminal."""
        return self._before is not None

    def requests(self) -> list[str]:
        if self._before is None or not select.select([self._fd], [], [], 0)[0]:
            return []
        text = os.read(self._fd, 64).decode(errors="ignore")
        return [self.keys[key] for key in text if key in self.keys]

    def close(self) -> None:
        if self._before is not None:
            import termios

            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._before = None


class Gamepad:
    """Buttons of a joystick device of Linux, such as /dev/input/js0; a device that goes away means damping.

    Raises:
        OSError: if it cannot be opened.
    """

    _EVENT = struct.Struct("IhBB")  # ms, value, type, number

    def __init__(self, path: str, buttons: Mapping[int, str] = BUTTONS):
        self.buttons = buttons
        self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)

    def requests(self) -> list[str]:
        found = []
        while self._fd >= 0:
            try:
                data = os.read(self._fd, self._EVENT.size)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if len(data) < self._EVENT.size:
                self.close()
                found.append("damping")
                break
            _, value, kind, number = self._EVENT.unpack(data)
            if kind == 1 and value == 1 and number in self.buttons:  # pressed; 0x80 is the state at opening
                found.append(self.buttons[number])
        return found

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class Interrupts:
    """Signals that ask for the end, while a robot is driven: Ctrl-C, termination, a terminal that is gone.

    The first one only sets `asked`, so that no tick is cut in two; the second one raises `KeyboardInterrupt`, in case
    the loop does not come round any more; from the third on, or from `shield` on, they are ignored until the context
    ends. Elsewhere than in the main thread, which alone gets signals, this does nothing.
    """

    _SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

    def __init__(self) -> None:
        self.asked = 0
        self._before: dict[int, Any] = {}
        self._shielded = False

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in self._SIGNALS:
                self._before[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.asked += 1
        if self.asked == 2 and not self._shielded:
            raise KeyboardInterrupt

    def shield(self, actions: Iterable[Callable[[], object]]) -> list[BaseException]:
        """Does things that must be done, each whatever became of those before; no signal comes between.

        Returns:
            What they have raised.
        """
        errors: list[BaseException] = []
        todo = list(actions)
        self._shielded = True
        for action in todo:
            try:
                action()
            except BaseException as error:
                errors.append(error)
        return errors

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        del kind, error, at
        for number, handler in self._before.items():
            signal.signal(number, handler)
