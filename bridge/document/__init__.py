"""Documents for people: blocks, pictures and tables, written as HTML and as PDF."""
