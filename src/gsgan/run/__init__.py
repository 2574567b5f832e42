"""Runs: how a model is built from a config, stored, loaded again, and driven by motions."""
