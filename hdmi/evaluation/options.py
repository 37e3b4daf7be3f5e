"""Options of the scripts: `key=value` arguments checked against a dataclass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hdmi.build import ConfigError

T = TypeVar("T")


def parse_options(cls: type[T], arguments: Sequence[str]) -> T:
    """Options from `key=value` arguments; what is not given has the dataclass's default.

    Raises:
        ConfigError: for an argument without `=`, an unknown key, or a value of the wrong type.
    """
    known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
    for argument in arguments:
        key, equals, _ = argument.partition("=")
        if not equals:
            raise ConfigError(f"{argument!r}: expected key=value; the keys are {', '.join(known)}")
        if key not in known:
            raise ConfigError(f"unknown option {key!r}; there is {', '.join(known)}")
    try:
        options = OmegaConf.merge(OmegaConf.structured(cls), OmegaConf.from_cli(list(arguments)))
        return OmegaConf.to_object(options)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key}: {str(error).splitlines()[0]}") from error


def parse_motion_options(cls: type[T], arguments: Sequence[str]) -> tuple[Path, T]:
    """The motion's folder, which is the one argument without `=`, and the options.

    Raises:
        ConfigError: without such an argument, with several, and as `parse_options`.
    """
    paths = [argument for argument in arguments if "=" not in argument]
    if len(paths) != 1:
        raise ConfigError(f"give one motion folder, got {', '.join(paths) or 'none'}")
    return Path(paths[0]), parse_options(cls, [argument for argument in arguments if "=" in argument])


def parse_terminations(value: Any) -> list[str] | None:
    """`all` (those of the training) -> None, `none` -> [], a list or a single name -> names."""
    return None if value == "all" else parse_names(None if value == "none" else value)


def parse_names(value: Any) -> list[str]:
    """A list of names, a single one, or null for none."""
    if value is None:
        return []
    return [str(name) for name in (value if isinstance(value, list) else [value])]
