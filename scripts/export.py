"""`hdmi export` of a checkout: see hdmi/commands/export.py."""

import sys

from hdmi.commands.export import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
