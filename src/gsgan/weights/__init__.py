"""Pretrained networks: where their weights are found, their features, and LPIPS."""
