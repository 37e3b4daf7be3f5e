"""`hdmi plot` of a checkout: see hdmi/commands/plot.py."""

import sys

from hdmi.commands.plot import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
