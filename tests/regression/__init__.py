"""What a rearrangement of the code must not change; see README.md."""
