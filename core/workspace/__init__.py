"""Where an arm may be: joint limits, obstacles, the arm itself, lines of sight."""
