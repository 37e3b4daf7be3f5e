"""The commands: `hdmi VERB ...`, a module each, and how they read arguments and end."""

import os

# Physics and torch take turns on the same cores: idle torch threads must sleep, not spin. Read when torch is loaded,
# and set by commands alone: a program that imports the package has its own policy.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
