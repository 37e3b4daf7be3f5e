"""`hdmi tasks` of a checkout: see hdmi/commands/tasks.py."""

import sys

from hdmi.commands.tasks import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
