"""`hdmi deploy` of a checkout: see hdmi/commands/deploy.py."""

import sys

from hdmi.commands.deploy import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
