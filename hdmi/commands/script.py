"""How every command runs: what a user can put right is one line."""

from __future__ import annotations

import sys
from collections.abc import Callable

from rich.console import Console

from hdmi.config import ConfigError
from hdmi.console import make_console
from hdmi.learning.checkpoint import CheckpointError
from hdmi.learning.collectors import WorkerError
from hdmi.learning.logger import LoggerError
from hdmi.learning.trainer import DivergenceError
from hdmi.motion import MotionError

# What a user can put right: shown as one line, without a traceback.
USER_ERRORS = (
    ConfigError, MotionError, CheckpointError, DivergenceError, WorkerError, LoggerError, FileNotFoundError,
)  # fmt: skip


def run_script(
    body: Callable[[list[str], Console], int],
    arguments: list[str],
    doc: str | None,
    *,
    width: int = 150,
    errors: tuple[type[Exception], ...] = (),
) -> int:
    """Runs a script: shows its help, or does what it is for; what a user can put right is one line, not a traceback.

    Args:
        body: does it, and returns the exit status.
        doc: the help.
        width: of tables, where the output is no terminal.
        errors: what a user can put right besides `USER_ERRORS`, missing extras and what the file system says.

    Returns:
        The exit status: the body's, 0 after the help, 2 after a mistake, 130 when interrupted.
    """
    if arguments in (["-h"], ["--help"]):
        print(doc)
        return 0
    console = make_console(width)
    caught: tuple[type[Exception], ...] = (*USER_ERRORS, ImportError, OSError, *errors)
    try:
        return body(arguments, console)
    except caught as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
