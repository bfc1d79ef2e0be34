"""Effects on where the tool is."""
