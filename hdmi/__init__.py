"""HDMI: whole-body humanoid-object interaction by co-tracking reference motions, on TorchRL and MuJoCo."""

__version__ = "0.1.0"
