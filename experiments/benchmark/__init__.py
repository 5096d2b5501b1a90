"""How fast the filters are, as ratios to things measured in the same run."""
