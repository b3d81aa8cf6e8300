"""The web page of a live cell, and of a recorded run."""
