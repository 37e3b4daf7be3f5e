"""`hdmi benchmark` of a checkout: see hdmi/commands/benchmark.py."""

from hdmi.commands.benchmark import main

if __name__ == "__main__":
    main()
