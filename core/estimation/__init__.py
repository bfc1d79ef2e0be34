"""Estimation of compliance and of its siblings: robust, streamed, and over many arms."""
