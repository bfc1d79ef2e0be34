"""A simulated UR controller: a server process with a hidden plant behind the real protocols."""
