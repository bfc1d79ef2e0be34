"""Makes the truth makers beside the tests importable, from the folders below too."""
