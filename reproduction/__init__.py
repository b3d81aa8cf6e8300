"""The paper's questions, asked of the simulated cell with Dwell's public names alone."""
