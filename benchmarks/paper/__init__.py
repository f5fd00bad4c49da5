"""The paper's experiments on open data: its method, ours, and each step by ablation."""
