"""The protocol: messages, keys, and who connects to whom."""
