"""Which effects explain a log: candidates, search, outliers and noise."""
