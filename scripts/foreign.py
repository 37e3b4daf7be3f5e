"""`hdmi foreign` of a checkout: see hdmi/commands/foreign.py."""

import sys

from hdmi.commands.foreign import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
