"""`hdmi simulate-robot` of a checkout: see hdmi/commands/simulate_robot.py."""

import sys

from hdmi.commands.simulate_robot import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
