"""How the commands run that need no trainer: what a user can put right is one line."""

from __future__ import annotations

import sys
from collections.abc import Callable

from rich.console import Console

from hdmi.console import make_console
from hdmi.deploy.description import PolicyError
from hdmi.deploy.log import LogError
from hdmi.deploy.robot import RobotError
from hdmi.errors import ConfigError


def run_deployed(body: Callable[[list[str], Console], int], arguments: list[str], shown: Callable[[], str]) -> int:
    """Runs a command without hydra or torch.

    Args:
        body: does it, and returns the exit status.
        shown: the help.

    Returns:
        The exit status: the body's, 0 after the help, 2 after a mistake, 130 when interrupted.
    """
    if arguments in (["-h"], ["--help"]):
        print(shown())
        return 0
    try:
        return body(arguments, make_console())
    except (ConfigError, PolicyError, RobotError, LogError, ImportError, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
