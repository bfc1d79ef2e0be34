"""The application around core and drivers: command line, cell files, daemon, reports."""
