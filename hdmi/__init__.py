"""HDMI: whole-body humanoid-object interaction by co-tracking reference motions, on TorchRL and MuJoCo."""

import os

# Physics and torch take turns on the same cores: idle torch threads must sleep, not spin. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
