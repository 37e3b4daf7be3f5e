"""What importing a piece brings along."""

from __future__ import annotations

import subprocess
import sys

import pytest

# what transforms and kernels may not need, and what they may not change in a stranger's process
BLOCKED = """
import os, sys
before = dict(os.environ)
for name in ("mujoco", "scipy", "trimesh", "hydra", "omegaconf", "matplotlib", "wandb", "mink", "warp"):
    sys.modules[name] = None  # importing it fails
{body}
ours = {{key: value for key, value in os.environ.items() if before.get(key) != value}}
import torchrl, tensordict
assert {{key for key in ours if key.startswith(("OMP", "MUJOCO", "HDMI"))}} == set(), ours
assert not [name for name in sys.modules if name.startswith(("hdmi.assets", "hdmi.motion", "hdmi.envs"))]
"""


@pytest.mark.parametrize(
    "body",
    [
        "from hdmi.transforms import InteractionReward; InteractionReward()",
        "from hdmi.transforms import VectorInRoot; VectorInRoot('a', 'b')",
        "import hdmi.transforms as T; [getattr(T, name) for name in T.__all__]",
        "from hdmi.functional import interaction",
    ],
)
def test_transforms_need_torch_torchrl_and_tensordict_only(body: str):
    """In a process in which nothing else can be imported."""
    command = [sys.executable, "-c", BLOCKED.format(body=body)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
