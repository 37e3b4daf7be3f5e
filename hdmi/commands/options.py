"""Options of the scripts: `key=value` arguments checked against a dataclass.

A value is the text after the first `=`, and the field's declared type decides what that text means: nothing in a path
or a name is special.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, make_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from hdmi.errors import ConfigError

T = TypeVar("T")

_BOOLS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def parse_options(cls: type[T], arguments: Sequence[str]) -> T:
    """Options from `key=value` arguments; what is not given has the dataclass's default.

    Fields may be str, int, float, bool, a list of one of these, or one of these or None. A list is `a,b` or `[a,b]`;
    commas in brackets do not separate.

    Raises:
        ConfigError: for an argument without `=`, an unknown key, or a value of the wrong type.
    """
    types, values = get_type_hints(cls), {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals:
            raise ConfigError(f"{argument!r}: expected key=value; the keys are {', '.join(_keys(cls))}")
        if key not in _keys(cls):
            raise ConfigError(_unknown(cls, key))
        values[key] = _convert(types[key], text, key)
    return cls(**values)


def parse_parts(parts: Sequence[type], arguments: Sequence[str]) -> dict[type, Any]:
    """Options of several dataclasses at once, by the class; what two of them call the same is the same.

    Raises:
        ConfigError: as `parse_options`.
    """
    found: dict[str, tuple[str, Any, Any]] = {}
    for part in parts:
        hints = get_type_hints(part)
        found |= {f.name: (f.name, hints[f.name], f) for f in fields(part)}
    everything: Any = parse_options(make_dataclass("Options", found.values()), arguments)
    return {part: part(**{f.name: getattr(everything, f.name) for f in fields(part)}) for part in parts}


def shown_help(doc: str | None, parts: Mapping[str, type]) -> str:
    """A command's help, with titled options and their defaults for `{options}`."""
    lines = [f"{title}: " + " ".join(f"{k}={v}" for k, v in vars(part()).items()) for title, part in parts.items()]
    return (doc or "").replace("{options}", "Options and their defaults:\n\n" + "\n\n".join(lines))


def parse_motion_options(cls: type[T], arguments: Sequence[str]) -> tuple[Path, T]:
    """The motion's folder, which is the one argument that is no option, and the options.

    A path may have `=` in it, as long as what stands before it is no option's name: write ./task=b and not task=b.

    Raises:
        ConfigError: without such an argument, with several, and as `parse_options`.
    """
    options = [argument for argument in arguments if argument.partition("=")[:2] in [(k, "=") for k in _keys(cls)]]
    paths = [argument for argument in arguments if argument not in options]
    for path in paths:
        key, equals, _ = path.partition("=")
        if equals and re.fullmatch(r"[\w-]+", key) and not Path(path).exists():
            raise ConfigError(f"{_unknown(cls, key)}; nor is there a folder {path}")
    if len(paths) != 1:
        raise ConfigError(f"give one motion folder, got {', '.join(paths) or 'none'}")
    return Path(paths[0]), parse_options(cls, options)


def parse_terminations(value: str | Sequence[str] | None) -> list[str] | None:
    """`all` (those of the training) -> None, `none` -> [], a list or a single name -> names."""
    names = _split(value) if isinstance(value, str) else list(value or ())
    if names == ["all"]:
        return None
    return [] if names == ["none"] else names


def _keys(cls: type) -> list[str]:
    return [f.name for f in fields(cls)]


def _unknown(cls: type, key: str) -> str:
    close = difflib.get_close_matches(key.strip("-").replace("-", "_"), _keys(cls), 1)
    meant = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown option {key!r}{meant}; there is {', '.join(_keys(cls))}"


def _convert(kind: Any, text: str, key: str) -> Any:
    """The value that a text means as a type."""
    if get_origin(kind) in (Union, UnionType):
        if NoneType in get_args(kind) and kind != str | None and text in ("null", "none"):
            return None
        kind = next(part for part in get_args(kind) if part is not NoneType)
    if get_origin(kind) is list:
        return [_convert(get_args(kind)[0], item, key) for item in _split(text)]
    if not text:
        raise ConfigError(f"{key}: a value expected after {key}=")
    what, convert = _SCALARS.get(kind, _SCALARS[str])
    try:
        return convert(text)
    except (ValueError, KeyError) as error:
        raise ConfigError(f"{key}: {what} expected, got {text!r}") from error


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


_SCALARS: dict[Any, tuple[str, Callable[[str], Any]]] = {
    str: ("text", str),
    int: ("a whole number", int),
    float: ("a number", _finite),
    bool: ("true or false", lambda text: _BOOLS[text.lower()]),
}


def _split(text: str) -> list[str]:
    """The items of `a,b` or `[a,b]`; commas in brackets do not separate."""
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1]
    items, depth = [""], 0
    for char in text:
        depth += (char in "[{(") - (char in "]})")
        if char == "," and depth == 0:
            items.append("")
        else:
            items[-1] += char
    return [item.strip().strip("'\"") for item in items if item.strip()]
