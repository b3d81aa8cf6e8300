"""What is random in a scenario, drawn and laid out, and the compiled event loop over it."""
