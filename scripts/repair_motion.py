"""`hdmi repair` of a checkout: see hdmi/commands/repair.py."""

import sys

from hdmi.commands.repair import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
