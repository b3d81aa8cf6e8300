"""Web page of a live cell, a recorded run, a recorded fleet or a folder of runs."""
