"""`hdmi annotate` of a checkout: see hdmi/commands/annotate.py."""

import sys

from hdmi.commands.annotate import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
