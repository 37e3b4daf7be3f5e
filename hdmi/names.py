"""Names and keys that several rooms share: matching of joints and bodies by pattern, keys of a start."""

from __future__ import annotations

import re
from collections.abc import Sequence

from tensordict import NestedKey

FRAME_KEY: NestedKey = ("init", "frame")  # where an episode starts, int64 [N, 1]
REWIND_KEY: NestedKey = ("init", "rewind_frame")  # likewise, negative where it is to be drawn
NOISE_SHARE_KEY: NestedKey = ("init", "noise_share")  # factor of a start's perturbations, [N, 1]


def match_names(patterns: Sequence[str], names: Sequence[str], where: str = "names") -> list[int]:
    """Indices of `names` that fully match any of the regular expressions, in the order of `names`.

    Raises:
        ValueError: if a pattern matches nothing; names the pattern and what there is.
    """
    for pattern in patterns:
        if not any(re.fullmatch(pattern, name) for name in names):
            raise ValueError(f"{where}: {pattern!r} matches none of {list(names)}")
    return [i for i, name in enumerate(names) if any(re.fullmatch(pattern, name) for pattern in patterns)]
