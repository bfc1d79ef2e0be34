"""The daemon's HTTP servers: addresses, authentication and limits."""
