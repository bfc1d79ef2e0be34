"""Small mistakes put into the product one at a time, and whether its tests notice each."""
