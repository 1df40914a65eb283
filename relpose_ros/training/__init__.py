"""The objective, and the loop that lowers it."""
