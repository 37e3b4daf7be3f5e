"""Trains a policy: `python train.py [group=choice ...] [node.key=value ...] [+ablation=name]`."""

from hdmi.commands.train import main

if __name__ == "__main__":
    main()
