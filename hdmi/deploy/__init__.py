"""Policies that leave the trainer: their transform stack as one graph, from sensors to joint targets."""
