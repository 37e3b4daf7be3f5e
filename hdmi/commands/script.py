"""How every command runs: what a user can put right is one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from yaml import YAMLError

from hdmi.config import ConfigError, composition_fault, use_installed_configs
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
_FULL_ERROR = "HYDRA_FULL_ERROR"


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
    except OmegaConfBaseException as error:  # such as a variable of the environment that a config names
        print(f"ConfigError: {composition_fault(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def run_composed(body: Callable[[], None]) -> None:
    """Runs a function of `hydra.main`, with the configs of installed packages.

    What a user can put right is one line and exit status 2; with HYDRA_FULL_ERROR=1 in the environment a traceback.
    """
    full = os.environ.get(_FULL_ERROR)
    os.environ[_FULL_ERROR] = "1"  # Hydra raises then, instead of printing several lines and exiting with 1
    try:
        use_installed_configs()
        body()
    except (HydraException, OmegaConfBaseException, YAMLError, ImportError, *USER_ERRORS) as error:
        if full == "1":
            raise
        own = isinstance(error, (ImportError, *USER_ERRORS))
        fault = f"{type(error).__name__}: {error}" if own else f"ConfigError: {composition_fault(error)}"
        print(fault, file=sys.stderr)
        sys.exit(2)
    finally:
        if full is None:
            del os.environ[_FULL_ERROR]
        else:
            os.environ[_FULL_ERROR] = full
