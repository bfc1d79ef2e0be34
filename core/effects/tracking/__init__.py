"""Effects on how encoders follow their commands."""
