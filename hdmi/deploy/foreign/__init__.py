"""Policies of others: networks that a YAML describes, run in the place of an exported policy. Needs no torch."""
