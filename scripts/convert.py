"""`hdmi convert` of a checkout: see hdmi/commands/convert.py."""

import sys

from hdmi.commands.convert import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
