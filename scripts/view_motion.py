"""`hdmi view` of a checkout: see hdmi/commands/view.py."""

import sys

from hdmi.commands.view import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
