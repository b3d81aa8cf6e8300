"""The commands of live cells: each is declared in a light module, which imports what it needs."""
