"""`hdmi gpu-report` of a checkout: see hdmi/commands/gpu_report.py."""

import sys

from hdmi.commands.gpu_report import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
