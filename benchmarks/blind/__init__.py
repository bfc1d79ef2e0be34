"""The blind benchmark of the diagnosis: truth with withheld causes, and the score."""
