"""Results of experiments: each page is the output of the command that its first lines name."""
