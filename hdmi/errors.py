"""Mistakes of a user that every command shows as one line."""

from __future__ import annotations


class ConfigError(ValueError):
    """A config or an option that cannot be used; the message names the node or the option.

    Examples:
        >>> from hdmi.config import build
        >>> build({"_target_": "hdmi.assets.SimConfig", "step": 0.01}, "sim")
        Traceback (most recent call last):
        hdmi.errors.ConfigError: sim: SimConfig has no ['step']; it takes ...
    """
