"""Where the joint angles of a reading come from."""
