"""Documents of blocks, drawings and tables, written as HTML and PDF; texts of findings."""
