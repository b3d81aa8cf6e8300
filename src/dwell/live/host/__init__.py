"""The processes of a node: an agent starts them, watches them and gives them time and transport."""
