"""Workers: local processes, or a Dask cluster."""
