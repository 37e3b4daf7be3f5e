"""`hdmi validate` of a checkout: see hdmi/commands/validate.py."""

import sys

from hdmi.commands.validate import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
