"""Many arms, many sessions: fleets."""
