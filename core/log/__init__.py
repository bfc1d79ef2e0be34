"""Logs of a robot: read as CSV and Parquet, whole or in pieces, and as MCAP."""
