"""What an instrument tells of the TCP: one base, one file a kind, one table."""
