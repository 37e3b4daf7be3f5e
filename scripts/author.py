"""`hdmi author` of a checkout: see hdmi/commands/author.py."""

import sys

from hdmi.commands.author import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
