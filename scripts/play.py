"""`hdmi play` of a checkout: see hdmi/commands/play.py."""

import sys

from hdmi.commands.play import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
