"""Truth from elsewhere: other formulations of the same physics, without a line from core."""
