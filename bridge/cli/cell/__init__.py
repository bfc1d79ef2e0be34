"""Commands about a cell and its model."""
