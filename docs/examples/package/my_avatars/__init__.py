"""An ablation for gsgan."""
