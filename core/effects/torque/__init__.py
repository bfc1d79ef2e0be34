"""Effects on the joints' measured torques."""
