"""Messages to views to estimates to messages: the one scanner behind the node and the replay."""
