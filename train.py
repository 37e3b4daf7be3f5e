"""Trains a policy: `python train.py [group=choice ...] [node.key=value ...] [+ablation=name]`."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from hdmi.cli import main


@hydra.main(config_path="conf", config_name="config", version_base="1.3")
def run(cfg: DictConfig) -> None:
    main(cfg)


if __name__ == "__main__":
    run()
