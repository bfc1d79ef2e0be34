"""Effects on what the flange sensor reads."""
