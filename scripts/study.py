"""`hdmi study` of a checkout: see hdmi/commands/study.py."""

import sys

from hdmi.commands.study import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
