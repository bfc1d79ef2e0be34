"""Who does the tasks: processes of this machine, or a Dask cluster."""
