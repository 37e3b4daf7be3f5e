"""`hdmi retarget` of a checkout: see hdmi/commands/retarget.py."""

import sys

from hdmi.commands.retarget import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
