"""The simulator's inner loop: compiled functions over arrays, and nothing else."""
