"""A recorded bag instead of a running graph: through the same scanner, and onto one page."""
