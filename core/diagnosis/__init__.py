"""The diagnosis: which physical effects explain what a log shows of an arm's error."""
