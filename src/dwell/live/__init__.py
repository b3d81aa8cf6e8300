"""The live runtime: the roles of a cell, their protocol, and what carries it."""
