"""Work spread over processes and machines by Dask (docs/cluster.md)."""
