"""Commands of live cells; light modules declare them, and import the rest when they run."""
