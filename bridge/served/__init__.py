"""What the daemon serves to people and programs: who may listen, who may ask, and how much."""
