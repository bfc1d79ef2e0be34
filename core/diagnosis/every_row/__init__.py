"""Every row of a log judges: refitted as a whole, or block by block of a long recording."""
