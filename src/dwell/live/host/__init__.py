"""Processes of a node: the agent, which starts and supervises the others, and their hosting."""
