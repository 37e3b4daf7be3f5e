"""`hdmi record` of a checkout: see hdmi/commands/record.py."""

import sys

from hdmi.commands.record import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
