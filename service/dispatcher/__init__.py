"""The dispatcher: takes runs from the database to Dask workers and their results back. One is active at a time."""
