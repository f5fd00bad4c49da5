"""How far off an alignment is: on scenes with known truth, on real pairs, and at best."""
