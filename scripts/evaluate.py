"""`hdmi evaluate` of a checkout: see hdmi/commands/evaluate.py."""

import sys

from hdmi.commands.evaluate import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
